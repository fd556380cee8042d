"""How a fit is getting on, in the line that its command shows."""

from ..core.progress import Progress
from ..fit.trainer import Fit

_SMOOTHING = 0.95  # of the PSNR that it shows


class FitLine:
    """What ``progress`` tells of the steps of ``fit``, from now on."""

    def __init__(self, fit: Fit, progress: Progress) -> None:
        self._fit, self._progress, self._psnr, self._elapsed = fit, progress, None, fit.elapsed

    def update(self) -> None:
        """Tell of the step that has been made."""
        fit, milliseconds = self._fit, 1e3 * (self._fit.elapsed - self._elapsed)
        self._psnr = fit.psnr if self._psnr is None else _SMOOTHING * self._psnr + (1 - _SMOOTHING) * fit.psnr
        self._elapsed = fit.elapsed
        self._progress.update(fit.progress, psnr=self._psnr, surfels=len(fit.model), ms=milliseconds, pixels=fit.pixels)
