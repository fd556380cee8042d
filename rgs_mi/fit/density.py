"""Adaptive density control: clone, split, prune (3DGS § 5, 2DGS). The optimizer's moments follow the surfels."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..core.bounding_box import BoundingBox
from ..core.camera import Camera
from ..settings.settings import Density
from ..surfels.surfels import Surfels
from .model import Model, logit
from .ranks import Ranks
from .reflection_guided import boxes, guided

_SPLIT_SCALE = 1.6  # a split surfel's halves are that much smaller (3DGS)


class Statistics:
    """Sums over the views that list a surfel, for ``n`` surfels.

    count     1: how many these are
    gradient  length of the gradient of the loss on the image plane, with respect to the projected center, NDC units (3DGS)
    weight    Σ w over the pixels, the part of a picture that it makes
    share     Σ w l over the pixels, its part of the photometric loss, whose value at a pixel is l
    """

    def __init__(self, n: int) -> None:
        self.count, self.gradient, self.weight, self.share = (dr.zeros(mi.Float, n) for _ in range(4))

    def add(
        self,
        index: "mi.UInt32",
        gradient: "mi.Vector2f",
        contribution: "mi.Vector2f",
        seen: "mi.Bool",
        size: tuple[int, int],
    ) -> None:
        """Add a view of ``size`` (width, height) pixels. Of the surfels ``index``, none of them twice, it listed those ``seen``;
        ``gradient`` is that of the loss with respect to their projected centers in pixels, and ``contribution`` are weight and
        share. What overflowed counts as zero."""
        length = dr.norm(mi.Vector2f(gradient.x * (size[0] / 2), gradient.y * (size[1] / 2)))
        for total, value in zip(self.sums(), (mi.Float(1), length, *contribution)):
            value = dr.select(seen & dr.isfinite(value), value, 0)
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, index, mode=dr.ReduceMode.NoConflicts)
        dr.eval(self.sums())

    def sums(self) -> "list[mi.Float]":
        """Return all of them."""
        return list(vars(self).values())

    def merge(self, sums: "Sequence[mi.Float]") -> None:
        """Add another's `sums`, of the same surfels."""
        for name, value in zip(vars(self), sums):
            setattr(self, name, getattr(self, name) + value)
        dr.eval(self.sums())

    def mean(self, name: str) -> np.ndarray:
        """Return the mean [N] of one of them over the views that list a surfel, zero where none does."""
        return getattr(self, name).numpy() / np.maximum(self.count.numpy(), 1)

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that a checkpoint needs, as NumPy arrays."""
        return {f"statistics_{name}": value.numpy() for name, value in vars(self).items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the `state` that a checkpoint has."""
        for name in vars(self):
            setattr(self, name, as_float(arrays[f"statistics_{name}"]))


class DensityControl:
    """Density control of a fit under ``settings``: its statistics, and where views saw something reflective.

    ``extent`` is the radius of the object in world units, ``box`` is around the object where there are surroundings, else
    None; ``n`` is the number of surfels.
    """

    def __init__(self, settings: Density, extent: float, box: BoundingBox | None, n: int) -> None:
        # What lies around the object is large, and all else little beside it; and what shows through its holes is nobody's share
        self.settings = settings if box is None else replace(settings, prune_weight=0, grow_by="gradient")
        self.extent, self.box = extent, box
        self.statistics = Statistics(n)
        self.reflective: dict[int, tuple[Camera, np.ndarray]] = {}  # by view: its camera, and boxes of what is reflective

    @property
    def weighs(self) -> bool:
        """Whether it asks for what surfels weigh in pictures, and for their shares of the loss."""
        return self.settings.prune_weight > 0 or self.settings.grow_by == "loss"

    def note_reflective(self, view: int, camera: Camera, mask: np.ndarray) -> None:
        """Remember what is reflective in the view of this index, where that guides density control; ``mask`` is its β̂,
        [H, W] bool."""
        if self.settings.guided:
            self.reflective[view] = camera.baked(), boxes(mask)

    def share(self, ranks: Ranks) -> None:
        """Take over what other processes have noted."""
        if self.settings.guided:
            self.reflective = {view: noted for part in ranks.gather(self.reflective) for view, noted in part.items()}

    def guided(self, model: Model) -> np.ndarray | None:
        """Return [N] which surfels get half the threshold (RGS, Algorithm 1); None where nothing guides."""
        if not self.reflective:
            return None
        return guided(model.numpy("centers"), *zip(*self.reflective.values()))

    def refine(self, model: Model, rng: np.random.Generator, budget: int | None) -> np.ndarray | None:
        """End a round of statistics: `densify`, unless ``budget`` is None, and begin the next. Returns what `densify` does."""
        parents = None
        if budget is not None:
            parents = densify(model, self.statistics, self._extents(model), self.settings, rng, budget, self.guided(model))
        self.statistics = Statistics(len(model))
        return parents

    def _extents(self, model):
        """What is large for a surfel: the object, or the distance from it in the surroundings."""
        if self.box is None:
            return self.extent
        return np.maximum(self.extent, np.linalg.norm(model.numpy("centers") - self.box.center, axis=1))


def densify(
    model: Model,
    statistics: Statistics,
    extent: float | np.ndarray,
    settings: Density,
    rng: np.random.Generator,
    budget: int,
    guided: np.ndarray | None = None,
) -> np.ndarray | None:
    """Do one round of density control, in place; returns which surfel each one was before, or was made of, None where all stay
    as they are. ``extent`` is the radius of the object in world units, or [N] what is large for each surfel.

    Surfels grow, the neediest first while ``budget`` (surfels in all) lasts, by what `Density.grow_by` says:

    gradient  where their mean gradient exceeds the threshold they are cloned when small and split when large (3DGS)
    loss      where they have more of the photometric loss than surfels in the mean (after Rota Bulò et al. 2024) they are split

    For those that are ``guided`` ([N] bool or None) half of that is enough (RGS, Algorithm 1). Transparent, unseen and huge ones
    go, and those that others hide, or that make next to nothing of any picture.
    """
    opacity = 1 / (1 + np.exp(-model.numpy("logit_opacities")[:, 0]))
    scales = np.exp(model.numpy("log_scales"))
    largest = scales.max(1)
    weight, listed = statistics.mean("weight"), statistics.count.numpy() > 0
    keep = listed & (opacity > settings.prune_opacity) & (largest < 0.3 * extent)
    keep &= weight >= settings.prune_weight * weight.mean()
    if not keep.any():
        return None

    if settings.grow_by == "loss":
        share = statistics.mean("share")
        need, large = share / max(share[keep].mean(), 1e-20), np.full(len(model), True)
    else:
        need, large = statistics.mean("gradient") / settings.grow_grad2d, largest > settings.grow_scale3d * extent
    if guided is not None:
        need = need * np.where(guided, 2, 1)
    hot = np.flatnonzero(keep & (need > 1))
    room = max(0, budget - int(keep.sum()))
    hot = hot[np.argsort(-need[hot], kind="stable")][:room]

    # Those that grow are there twice, one beside the other: what is near is to lie together in memory, too
    index = np.sort(np.concatenate([np.flatnonzero(keep), hot]))
    grown, fresh = np.isin(index, hot), np.append(False, index[1:] == index[:-1])
    changed = "centers", "log_scales", "logit_opacities", "delta_normal", "curvature"
    changes = {name: model.numpy(name)[index] for name in changed} | {"fresh": fresh}

    # Both halves of a split are drawn from the parent; they lie in its plane, with the normals it has where they are.
    # Each surfel has its own draw: one that is split in this run and not in the next changes nothing for the others.
    halves = np.flatnonzero(grown & large[index])
    parents = index[halves]
    (t_u, t_v), normal_derivatives = ([v.numpy().T[parents] for v in pair] for pair in _tangents(model))
    draws = rng.normal(size=(2, len(model), 2)).astype(np.float32)
    u, v = draws[fresh[halves].astype(int), parents].T[..., None]
    s_u, s_v = scales[parents, :, None].transpose(1, 0, 2)
    changes["centers"][halves] += u * s_u * t_u + v * s_v * t_v
    changes["delta_normal"][halves] += u * normal_derivatives[0] + v * normal_derivatives[1]
    changes["curvature"][halves] /= _SPLIT_SCALE
    changes["log_scales"][halves] -= np.log(_SPLIT_SCALE)
    # Two surfels on one spot cover as much as one did: 1 − (1 − o')² = o.
    twins = np.flatnonzero(grown & ~large[index])
    changes["logit_opacities"][twins, 0] = logit(1 - np.sqrt(1 - opacity[index[twins]]))
    model.select(index, changes)
    return index


def _tangents(model):
    """(t_u, t_v) and (∂n/∂u, ∂n/∂v) of all surfels."""
    surfels: Surfels = model.surfels(0)
    with dr.suspend_grad():
        return surfels.frames()[:2], surfels.normal_derivatives()
