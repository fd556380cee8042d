"""A window on a finished run. What `rgs-mi view` calls."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..core.errors import UserError
from ..core.runtime import HOST, PORT
from ..core.scene_files import load_scene
from ..datasets import load_dataset
from ..export.mitsuba_scene import SCENE
from ..report.results import finished, photographs_of
from ..viewer.exports import Exports
from ..viewer.server import Server, check
from ..viewer.subject import Subject
from .export import FORMATS, export


def view(
    path: str | Path,
    *,
    variables: Mapping[str, object] | None = None,
    data: str | Path | None = None,
    envmaps: Sequence[str | Path] = (),
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Show a scene of surfels in a window until Ctrl-C.

    Args:
      path:      a run's folder, or a scene file
      variables: of the scene, to override its defaults
      data:      the folder of its photographs (None: where the run's metrics.json says that they were, if anywhere)
      envmaps:   images, latitude-longitude, that the window offers as lights; no page can name others
      host, port: where the page is

    Raises: UserError for a scene that can't be shown, a port that is taken, and where viser is not installed.
    """
    check(host, port)
    path = Path(path)
    scene = path / SCENE if path.is_dir() else path
    subject = Subject.of(load_scene(scene, variables or {}), envmaps)  # whose light is filtered meanwhile, in a thread
    subject.compare_with(_photographs(path, data))
    offer = Exports(FORMATS, lambda to: export(path, to, quiet=True)).offer if finished(path) else None
    server = Server(subject, str(path), host, port, offer)
    print(f"{server.address} (Ctrl-C closes it)", flush=True)
    try:
        server.run()
    finally:
        server.close()


def _photographs(path, data):
    """The views that were fitted; none, with a line that says so, where they are gone. Raises: UserError for a folder that was
    given and holds none."""
    if data is not None:
        return load_dataset(data).train
    folder, longest = photographs_of(path)
    if folder is None:
        return []  # of no run
    try:
        return load_dataset(folder, longest).train
    except UserError as error:
        print(f"without photographs: {error}", file=sys.stderr)
        return []
