"""Splats as OpenUSD's particle fields (26.03 and later), under a dome light."""
# pyright: reportAttributeAccessIssue=false
# OpenUSD's modules fill themselves when they are imported.

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file, write_exr
from .splats import DEGREE, Splats

NAME, DOME = "splats.usdc", "environment.exr"
KERNELS = ("ellipsoid", "surflet")
_EXTENT = 3  # standard deviations


def check() -> None:
    """Make sure that OpenUSD is there, in a version that knows splats. Raises: UserError where it is not."""
    try:
        from pxr import UsdVol
    except ImportError as error:
        raise UserError("--to usd: OpenUSD is not installed: pip install 'rgs-mi[usd]'") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise UserError("--to usd: OpenUSD is older than 26.03 and knows no splats: pip install -U usd-core")


def write(
    folder: str | Path, splats: Splats, environment: np.ndarray | None = None, kernel: str = "ellipsoid"
) -> list[Path]:
    """Write ``splats`` and the ``environment`` that they were baked under (latitude-longitude, [rows, columns, 3], linear
    radiance; None: none), both in a world whose y axis points up, as `NAME` and `DOME` into ``folder``; return the paths.

    ``kernel`` 'ellipsoid' makes them a ``ParticleField3DGaussianSplat``, which readers of splats know; 'surflet' a
    ``ParticleField`` of flat Gaussians, which is what surfels are. Longitudes of the map are those of a dome light without
    turning it: both have their middle column in +z, and +x a quarter of the width to its left. Splats are put where
    their origin is.

    Raises: UserError where OpenUSD is missing, the disk is full or the folder can't be written.
    """
    check()
    from pxr import Sdf, Usd, UsdGeom, UsdLux

    path = Path(folder) / NAME
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / NAME
        stage = Usd.Stage.CreateNew(str(file))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(root.GetPrim())
        _field(stage, "/World/Splats", splats, kernel)
        if any(splats.origin):
            UsdGeom.Xformable(stage.GetPrimAtPath("/World/Splats")).AddTranslateOp().Set(splats.origin)
        if environment is not None:
            write_exr(path.with_name(DOME), environment)
            dome = UsdLux.DomeLight.Define(stage, "/World/Environment")
            dome.CreateTextureFileAttr(Sdf.AssetPath(f"./{DOME}"))
            dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        stage.GetRootLayer().Save()
        with atomic_file(path) as stream:
            stream.write(file.read_bytes())
    return [path] if environment is None else [path, path.with_name(DOME)]


def _field(stage, name, splats, kernel):
    """Define the particle field ``name`` on the ``stage``."""
    from pxr import UsdGeom, UsdVol, Vt

    if kernel == "surflet":
        field: Any = UsdVol.ParticleField.Define(stage, name)
        position, orientation, scale, opacity, _, radiance = (
            getattr(UsdVol, f"ParticleField{part}API").Apply(field.GetPrim())
            for part in (
                "PositionAttribute",
                "OrientationAttribute",
                "ScaleAttribute",
                "OpacityAttribute",
                "KernelGaussianSurflet",
                "SphericalHarmonicsAttribute",
            )
        )
    else:
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, name)
        position = orientation = scale = opacity = radiance = field
    position.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.centers))
    orientation.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(splats.rotations))  # (x, y, z, w) in memory, too
    scale.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(splats.thick_scales))
    opacity.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    radiance.CreateRadianceSphericalHarmonicsDegreeAttr(DEGREE)
    radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(splats.harmonics.reshape(-1, 3)))
    reach = _EXTENT * splats.scales.max(1, keepdims=True)
    extent = np.stack([(splats.centers - reach).min(0), (splats.centers + reach).max(0)])
    UsdGeom.Boundable(field.GetPrim()).CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.float32(extent)))
