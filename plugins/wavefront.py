"""
Values of a wavefront as a texture (:monosp:`wavefront`)
--------------------------------------------------------

Lane *k* of an evaluation sees entry *k* of ``values``, whatever the surface: so a BSDF of Mitsuba's can be
evaluated for many materials at once, each lane its own. Set ``values`` before each evaluation; its width must be one or that
of the evaluation. For code, not for scene files.

.. pluginparameters::

 * - channels
   - |int|
   - 1 or 3 (Default: 1)
"""

import mitsuba as mi


class WavefrontTexture(mi.Texture):
    """``values``: ``mi.Float`` for one channel, ``mi.Color3f`` for three."""

    def __init__(self, props):
        super().__init__(props)
        self.channels = int(props.get("channels", 1))
        self.values = mi.Float(0.5) if self.channels == 1 else mi.Color3f(0.5)

    def eval(self, si, active=True):
        return mi.Color3f(self.values)

    def eval_1(self, si, active=True):
        return self.values

    def eval_3(self, si, active=True):
        return mi.Color3f(self.values)

    def is_spatially_varying(self):
        return True

    def to_string(self):
        return f"WavefrontTexture[channels = {self.channels}]"


mi.register_texture("wavefront", WavefrontTexture)
