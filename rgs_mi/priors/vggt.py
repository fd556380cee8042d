"""Depth by VGGT (Wang et al., CVPR 2025), through the API that its repository publishes, on torch.

Neither the package nor its weights come with this project. The network takes 5 GB of memory, and 0.2 to 0.3 GB for each view
of a batch; the time that a batch takes grows with its square.
"""

import hashlib
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.color import display
from ..core.errors import UserError
from ..datasets.images import resize
from ..datasets.types import DepthPrior, View
from .maps import masked

HUB = "facebook/VGGT-1B"
_SIDE, _PATCH = 518, 14  # of the longer side after VGGT's preprocessing, and of a token, in pixels
_NEEDED = ("aggregator.", "depth_head.")  # the parts of the network that depth takes
_OTHERS = "the priors hull, files and none work without"
_INSTALL = (
    "pip install torch torchvision einops huggingface_hub safetensors, then pip install --no-deps "
    "git+https://github.com/facebookresearch/vggt"
)


def estimate(
    views: Sequence[View], weights: str = HUB, batch: int = 24, overlap: int = 6, background: float = 1.0
) -> list[DepthPrior]:
    """Return VGGT's z-depths of all ``views`` and its confidences, which begin at 1; all in one unit.

    Args:
      views: they are seen as in display, over the grey level ``background`` where they have masks
      weights: name of a Hugging Face model, or a local ``.pt`` or ``.safetensors`` file, or a folder with one
      batch: most views that the network sees together; overlap: fewest that two batches in a row share

    The network chooses a scale for each batch. A correlation view by view doesn't feel it, but other uses do: each batch is
    brought to the scale of those before it by the median of the ratios, weighted by confidence, in the views that they
    share. Pixels outside the mask are unknown. Runs on a GPU where torch finds one, else (slowly) on the CPU.
    Raises: UserError without the packages, the weights, or memory enough.
    """
    if not 1 <= overlap < batch:
        raise UserError(f"vggt: batch is {batch} and overlap {overlap}: overlap must be at least 1 and less than batch")
    network = _Network(weights)
    priors: dict[int, DepthPrior] = {}
    with tempfile.TemporaryDirectory() as folder:
        files = [_write(Path(folder) / f"{i:06}.png", view, background) for i, view in enumerate(views)]
        for chosen in batches(len(views), batch, overlap):
            # `crop`, the published default, cuts nothing off, and pads nothing, where all are of one shape, not upright.
            shapes = {views[i].pixels.shape[:2] for i in chosen}
            mode = "crop" if len(shapes) == 1 and all(h <= w for h, w in shapes) else "pad"
            found = [_prior(views[i], *maps) for i, maps in zip(chosen, network([files[i] for i in chosen], mode))]
            scale = _scale([(priors[i], new) for i, new in zip(chosen, found) if i in priors])
            for i, new in zip(chosen, found):
                priors.setdefault(i, DepthPrior(new.values * scale, False, new.confidence))
    return [priors[i] for i in range(len(views))]


def batches(count: int, batch: int, overlap: int) -> list[range]:
    """Return the fewest, equally long ranges of at most ``batch`` that cover ``count`` views and share ``overlap`` or more
    with the next."""
    if count <= batch:
        return [range(count)]
    n = -(-(count - overlap) // (batch - overlap))
    size = -(-(count + (n - 1) * overlap) // n)
    starts = [k * (count - size) // (n - 1) for k in range(n)]
    return [range(start, start + size) for start in starts]


def fingerprint(weights: str) -> str:
    """Return what distinguishes weights from others: a hub's name, or a hash of a file's size and of 1024 samples spread over
    it (to read five gigabytes would take longer than to use them). Raises: UserError where no such file is."""
    path = _local(weights)
    if path is None:
        return f"hub:{weights}"
    size, digest = path.stat().st_size, hashlib.sha256()
    digest.update(str(size).encode())
    with open(path, "rb") as stream:
        for k in range(1024):
            stream.seek(k * max(size - 4096, 0) // 1023)
            digest.update(stream.read(4096))
    return digest.hexdigest()


# ---- Photographs to the network and maps back ----


def _write(path, view, background) -> str:
    """The photograph as a PNG over ``background``: the published loader reads files."""
    from PIL import Image

    Image.fromarray(np.uint8(np.round(255 * np.clip(display(view.pixels, background), 0, 1)))).save(path, compress_level=1)
    return str(path)


def _prior(view, depth, confidence) -> DepthPrior:
    """Maps [h, w] of the network at the size of the view's photograph, their border undone."""
    (height, width), (h, w) = view.pixels.shape[:2], depth.shape
    long = max(height, width)
    # As in VGGT's preprocessing: the longer side to 518, the other to a multiple of 14, the rest of a square padded.
    inner = [_SIDE if n == long else round(n * (_SIDE / long) / _PATCH) * _PATCH for n in (height, width)]
    top, left = (h - inner[0]) // 2, (w - inner[1]) // 2
    back = lambda x: resize(x[top : top + inner[0], left : left + inner[1]], height, width)
    values = masked(back(depth), view)
    return DepthPrior(values, False, np.where(np.isfinite(values), back(confidence), np.float32(0)))


def _scale(pairs) -> np.float32:
    """The factor that takes the second of each pair of priors to the first: a weighted median over all their pixels. 1 where
    they share none."""
    ratios, weights = [np.ones(0)], [np.ones(0)]
    for old, new in pairs:
        known = (old.values > 0) & (new.values > 0)
        ratios.append(old.values[known] / new.values[known])
        weights.append(old.confidence[known] * new.confidence[known])
    ratios, weights = np.concatenate(ratios), np.concatenate(weights)
    if not len(ratios):
        return np.float32(1)
    order = np.argsort(ratios)
    total = np.cumsum(weights[order], dtype=np.float64)
    return np.float32(ratios[order[np.searchsorted(total, total[-1] / 2)]])


# ---- The network ----


class _Network:
    """VGGT with the parts that depth takes."""

    def __init__(self, weights):
        path = _local(weights)
        try:
            import torch  # pyright: ignore[reportMissingImports]  # optional
            from vggt.models.vggt import VGGT  # pyright: ignore[reportMissingImports]  # optional
            from vggt.utils.load_fn import load_and_preprocess_images  # pyright: ignore[reportMissingImports]  # optional
        except ImportError as error:
            raise UserError(f"the vggt prior needs packages that are not there ({error}): {_INSTALL}; {_OTHERS}") from error
        try:
            model = VGGT.from_pretrained(weights) if path is None else VGGT()
            if path is not None:
                missing = model.load_state_dict(_state(path), strict=False).missing_keys
                if missing := [key for key in missing if key.startswith(_NEEDED)]:
                    raise ValueError(f"{len(missing)} weights are missing, the first is {missing[0]}")
        except Exception as error:  # whatever a hub, a network or a damaged file leads to
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            remedy = (
                f"check the network, or get model.pt from https://huggingface.co/{HUB} some other way and give its "
                "path as weights"
                if path is None
                else "download it again"
            )
            raise UserError(f"VGGT's weights {path or weights} cannot be loaded ({reason}): {remedy}; {_OTHERS}") from error
        model.camera_head = model.point_head = model.track_head = None  # their memory
        self.torch, self.load = torch, load_and_preprocess_images
        self.device = "cuda" if torch.cuda.is_available() else "cpu"
        self.model = model.to(self.device).eval()

    def __call__(self, files, mode) -> list[tuple[np.ndarray, np.ndarray]]:
        """Depth and confidence [h, w] of each of one batch of image files, at the size that preprocessing gave them."""
        torch, cuda = self.torch, self.device == "cuda"
        bfloat = not cuda or torch.cuda.get_device_capability()[0] >= 8  # Ampere and later
        dtype = torch.bfloat16 if bfloat else torch.float16
        try:
            with torch.no_grad():
                images = self.load(files, mode=mode).to(self.device)[None]  # [1, S, 3, h, w]
                with torch.autocast(self.device, dtype=dtype, enabled=cuda):
                    tokens, patch_start = self.model.aggregator(images)
                # [1, S, h, w, 1] and [1, S, h, w]; the heads were trained, and run, in float32
                depth, confidence = self.model.depth_head(tokens, images=images, patch_start_idx=patch_start)
                depth, confidence = (x.float().cpu().numpy() for x in (depth[0, ..., 0], confidence[0]))
        except (torch.cuda.OutOfMemoryError, MemoryError) as error:
            raise UserError(f"VGGT has no memory for batches of {len(files)} views: lower its option batch") from error
        return list(zip(depth, confidence))


def _local(weights) -> Path | None:
    """The file that ``weights`` means; None for the name of a model on the hub."""
    path = Path(weights).expanduser()
    if path.is_dir():
        path = next((p for p in (path / "model.safetensors", path / "model.pt") if p.is_file()), path / "model.pt")
    if path.is_file():
        return path
    if re.fullmatch(r"[\w.-]+/[\w.-]+", str(weights)) and path.suffix not in (".pt", ".safetensors"):
        return None
    raise UserError(
        f"VGGT's weights {path} do not exist: give a model.pt or model.safetensors, or a name on the hub such "
        f"as {HUB}; {_OTHERS}"
    )


def _state(path):
    """The weights in a file, by name."""
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file  # pyright: ignore[reportMissingImports]  # optional

        return load_file(path)
    import torch  # pyright: ignore[reportMissingImports]  # optional

    return torch.load(path, map_location="cpu", weights_only=True)
