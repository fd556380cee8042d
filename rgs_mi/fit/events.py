"""The rows of `curves.Curves` as TensorBoard's event files, RUN/tensorboard: `rgs-mi optimize --tensorboard`."""

import time
import warnings
from pathlib import Path
from typing import Any

from ..core.errors import UserError


def check() -> None:
    """Check that events can be written. Raises: UserError where tensorboardX is not installed."""
    try:
        import tensorboardX.event_file_writer  # noqa: F401
    except ImportError as error:
        raise UserError("--tensorboard: tensorboardX is not installed: pip install tensorboardX") from error


class Events:
    """Writes into ``folder`` what happens from ``step`` on: 0 replaces what is there, another goes on with it.

    Raises: UserError where tensorboardX is not installed or the folder can't be written.
    """

    def __init__(self, folder: str | Path, step: int) -> None:
        check()
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2, summary_pb2

        # their classes are made at import, where no type checker sees them
        self._event: Any = event_pb2.Event  # pyright: ignore[reportAttributeAccessIssue]
        self._summary: Any = summary_pb2.Summary  # pyright: ignore[reportAttributeAccessIssue]
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if step == 0:
                for stale in self.folder.glob("events.out.tfevents.*"):
                    stale.unlink()
            # not SummaryWriter: its thread dies of a full disk, and who waits for it hangs
            self._writer = EventsWriter(str(self.folder / "events"), f".{step}")
        except OSError as error:
            raise UserError(
                f"{folder}: can't be written ({error.strerror or error}): check the folder's permissions and "
                "free space, or leave out --tensorboard"
            ) from error
        if step > 0:  # what was written after the checkpoint that the fit goes on from no longer counts
            session_log: Any = event_pb2.SessionLog  # pyright: ignore[reportAttributeAccessIssue]
            self._write(step + 1, session_log=session_log(status=session_log.START))

    def add(self, row: dict) -> None:
        """A row of the curves: a scalar for each of its columns but ``step``. A full disk costs the row, not the fit."""
        scalars = {name.replace(".", "/"): value for name, value in row.items() if name != "step"}
        values = [self._summary.Value(tag=name, simple_value=value) for name, value in scalars.items()]
        self._write(row["step"], summary=self._summary(value=values))

    def close(self) -> None:
        """Close the file; to be called once."""
        self._guarded(self._writer.close)

    def _write(self, step, **content):
        event = self._event(wall_time=time.time(), step=step, **content)
        self._guarded(lambda: (self._writer.write_event(event), self._writer.flush()))

    def _guarded(self, write):
        try:
            write()
        except OSError as error:
            warnings.warn(f"{self.folder}: can't be written ({error.strerror or error}), the fit goes on", stacklevel=4)
