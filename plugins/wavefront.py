"""
Values of a wavefront as a texture (:monosp:`wavefront`)
--------------------------------------------------------

Entry *k* of an evaluation sees entry *k* of ``values``, whatever the surface: so a BSDF of Mitsuba's can be evaluated for
many materials at once, one per entry. Set ``values`` before each evaluation; its width must be one or that of the evaluation.
For code, not for scene files.

.. pluginparameters::

 * - channels
   - |int|
   - 1 or 3 (Default: 1)
"""

import mitsuba as mi


class WavefrontTexture(mi.Texture):
    """The texture shows ``values``, a ``mi.Float`` for one channel, a ``mi.Color3f`` for three."""

    def __init__(self, props: "mi.Properties") -> None:
        super().__init__(props)
        self.channels = int(props.get("channels", 1))
        self.values = mi.Float(0.5) if self.channels == 1 else mi.Color3f(0.5)

    def eval(self, si: "mi.SurfaceInteraction3f", active: "mi.Bool | bool" = True) -> "mi.Color3f":
        return mi.Color3f(self.values)

    def eval_1(self, si: "mi.SurfaceInteraction3f", active: "mi.Bool | bool" = True) -> "mi.Float":
        return self.values

    def eval_3(self, si: "mi.SurfaceInteraction3f", active: "mi.Bool | bool" = True) -> "mi.Color3f":
        return mi.Color3f(self.values)

    def is_spatially_varying(self) -> bool:
        return True

    def to_string(self) -> str:
        return f"WavefrontTexture[channels = {self.channels}]"


mi.register_texture("wavefront", WavefrontTexture)
