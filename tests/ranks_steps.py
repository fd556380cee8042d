"""What two processes do together, for `fit/test_ranks.py`: torchrun starts it; the first writes FILE, an npz."""

import sys
from dataclasses import replace

import numpy as np

import rgs_mi
from rgs_mi.fit.ranks import Ranks, started
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import Density

from fits import SETTINGS, model, random_photographs

STEPS = 8  # after which no gradient of the light waits, which each process has its own of (`LightMaps`)
GROWING = Density(start=0.0, stop=1.0, refine_every=4, grow_grad2d=1e-5, max_surfels=400)
# Which pixels are reflective is a threshold, which rounding passes: without the losses that ask
WEIGHTS = replace(SETTINGS.weights, normal=0.0, minimum_variation=0.0)
LEARNED = replace(SETTINGS, cameras="learned", exposure="learned", cameras_start=0.0, density=GROWING, weights=WEIGHTS)


def stepped(settings, ranks: Ranks, steps: int = STEPS) -> Fit:
    fit = Fit(random_photographs(), model(), settings, 1.0, ranks=ranks)
    for _ in range(steps):
        fit.step()
    return fit


def _apart(one, other):
    """The largest difference of two arrays."""
    return np.inf if one.shape != other.shape else np.abs(one.astype(float) - other.astype(float)).max(initial=0)


if __name__ == "__main__":
    rgs_mi.set_variant()
    with started() as ranks, ranks.sharing_cores():
        fit = stepped(LEARNED, ranks)
        arrays, meta = fit.state()
        everyone = ranks.gather((arrays, meta["elapsed"], fit.psnr))
    if not ranks.rank:
        apart = [_apart(array, everyone[1][0][name]) for name, array in arrays.items()]
        same = everyone[0][1:] == everyone[1][1:]
        np.savez(sys.argv[1], apart=max(apart), same=same, psnr=fit.psnr, **arrays)
