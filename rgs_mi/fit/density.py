"""Adaptive density control: clone, split, prune (3DGS § 5, 2DGS). The optimiser's moments follow the surfels."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..surfels.surfels import Surfels
from .model import logit

_SPLIT_SCALE = 1.6  # a split surfel's halves are that much smaller (3DGS)


class Gradients:
    """Running mean of the image-plane gradient of each surfel's centre, over the views that saw it."""

    def __init__(self, n: int):
        self.sum, self.count = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)

    def add(self, gradient, seen, size):
        """``gradient``: of the loss with respect to the projected centres in pixels, ``mi.Vector2f``; ``seen``: which
        surfels the view of ``size`` (width, height) listed. Kept in NDC units, as 3DGS measures it."""
        ndc = mi.Vector2f(gradient.x * (size[0] / 2), gradient.y * (size[1] / 2))
        self.sum += dr.select(seen, dr.norm(ndc), 0)
        self.count += dr.select(seen, mi.Float(1), 0)
        dr.eval(self.sum, self.count)

    def mean(self) -> np.ndarray:
        """[N]; zero for surfels that no view saw."""
        return self.sum.numpy() / np.maximum(self.count.numpy(), 1)


def densify(model, gradients: Gradients, extent: float | np.ndarray, settings, rng, budget: int, guided=None) -> None:
    """One round of density control, in place. ``extent``: radius of the object in world units, or [N] what is large for each
    surfel; ``settings``: `Density`.

    Surfels whose mean gradient exceeds the threshold are cloned when small and split when large, the largest gradients
    first while ``budget`` (surfels in all) lasts; for those that are ``guided`` ([N] bool or None) half the threshold is
    enough (RGS, Algorithm 1). Transparent, unseen and huge ones go.
    """
    gradient, seen = gradients.mean(), gradients.count.numpy() > 0
    if guided is not None:
        gradient = gradient * np.where(guided, 2, 1)
    opacity = 1 / (1 + np.exp(-model.numpy("logit_opacities")[:, 0]))
    scales = np.exp(model.numpy("log_scales"))
    largest = scales.max(1)
    keep = seen & (opacity > settings.prune_opacity) & (largest < 0.3 * extent)
    if not keep.any():
        return

    hot = np.flatnonzero(keep & (gradient > settings.grow_grad2d))
    room = max(0, budget - int(keep.sum()))
    hot = np.sort(hot[np.argsort(-gradient[hot], kind="stable")][:room])
    large = largest > settings.grow_scale3d * extent
    split, clone = hot[large[hot]], hot[~large[hot]]

    stay = np.flatnonzero(keep)
    index = np.concatenate([stay, clone, split])
    changed = "centers", "log_scales", "logit_opacities", "delta_normal", "curvature"
    changes = {name: model.numpy(name)[index] for name in changed}
    changes["fresh"] = np.arange(len(index)) >= len(stay)

    # Both halves of a split are drawn from the parent; they lie in its plane, with the normals it has where they are.
    # Each surfel has its own draw: one that is split in this run and not in the next changes nothing for the others.
    parents = np.isin(stay, split)
    halves = np.concatenate([np.flatnonzero(parents), np.arange(len(stay) + len(clone), len(index))])
    (t_u, t_v), normal_derivatives = ([v.numpy().T[index[halves]] for v in pair] for pair in _tangents(model))
    draws = rng.normal(size=(2, len(model), 2)).astype(np.float32)
    u, v = np.concatenate([draws[0, stay[parents]], draws[1, split]]).T[..., None]
    s_u, s_v = scales[index[halves], :, None].transpose(1, 0, 2)
    changes["centers"][halves] += u * s_u * t_u + v * s_v * t_v
    changes["delta_normal"][halves] += u * normal_derivatives[0] + v * normal_derivatives[1]
    changes["curvature"][halves] /= _SPLIT_SCALE
    changes["log_scales"][halves] -= np.log(_SPLIT_SCALE)
    # Two surfels on one spot cover as much as one did: 1 − (1 − o')² = o.
    twins = np.concatenate([np.flatnonzero(np.isin(stay, clone)), np.arange(len(stay), len(stay) + len(clone))])
    changes["logit_opacities"][twins, 0] = logit(1 - np.sqrt(1 - opacity[index[twins]]))
    model.select(index, changes)


def _tangents(model):
    """(t_u, t_v) and (∂n/∂u, ∂n/∂v) of all surfels."""
    surfels: Surfels = model.surfels(0)
    with dr.suspend_grad():
        return surfels.frames()[:2], surfels.normal_derivatives()
