"""How much memory this process has, and may still take."""

import os
from collections.abc import Iterator
from pathlib import Path


def available() -> int | None:
    """Return how many bytes this process may still take: the least of what the machine has free, what its control groups (of a
    container or a batch system) leave, and its own limits; None where the system says none of it."""
    return min([*_machine(), *_groups(), *_limits()], default=None)


def held() -> int:
    """Return how many bytes of memory this process holds now; 0 where the system does not say."""
    try:
        return _of_process()[1]
    except (OSError, ValueError):
        return 0


def words(size: float) -> str:
    """Return so many bytes in words: '1.2 GB'."""
    return f"{size / 1e9:.1f} GB"


def _machine() -> Iterator[int]:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                yield int(line.split()[1]) << 10
    except (OSError, ValueError):
        pass


def _groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[int]:
    """What each control group above this process leaves, of version 2 or 1."""
    try:
        entries = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        return
    for _, kinds, path in entries:
        if kinds == "":
            base, names = root, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in kinds.split(","):
            base, names = root / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        group = base / path.lstrip("/")
        while group.is_relative_to(base):
            yield from _left(group, *names)
            group = group.parent


def _left(group: Path, limit: str, used: str, cached: str) -> Iterator[int]:
    """What a control group leaves; what it holds of files that can go counts as free."""
    try:
        most, now = (group / limit).read_text().strip(), int((group / used).read_text())
        pages = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        if most != "max":
            yield max(int(most) - now + int(pages.get(cached, 0)), 0)
    except (OSError, ValueError):
        pass


def _limits() -> Iterator[int]:
    """What ``ulimit -v`` and ``ulimit -d`` leave."""
    try:
        import resource

        total, *_, data, _ = _of_process()
    except (ImportError, OSError, ValueError):
        return
    for kind, used in ((resource.RLIMIT_AS, total), (resource.RLIMIT_DATA, data)):
        soft, _ = resource.getrlimit(kind)
        if soft != resource.RLIM_INFINITY:
            yield max(soft - used, 0)


def _of_process() -> list[int]:
    """Bytes of this process, in the order of Linux's ``statm``: its addresses, what it holds in memory, …, its data, 0."""
    page = os.sysconf("SC_PAGE_SIZE")
    return [page * int(pages) for pages in Path("/proc/self/statm").read_text().split()]
