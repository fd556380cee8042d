"""The profile of a step: kernels and time are the innermost stage's."""

import drjit as dr
import mitsuba as mi

from rgs_mi.commands import step_profile


class Owner:
    def outer(self):
        dr.eval(dr.opaque(mi.Float, 2.0, 1000) + 1)
        self.inner()

    def inner(self):
        for k in range(3):
            dr.eval(dr.sin(dr.opaque(mi.Float, float(k), 1000)))


def test_kernels_are_the_innermost_stages(monkeypatch):
    monkeypatch.setattr(step_profile, "STAGES", {"outer": ((Owner, "outer"),), "inner": ((Owner, "inner"),)})
    monkeypatch.setattr(step_profile, "_LANES", 1 << 12)
    threads = dr.thread_count()
    stages = step_profile.profile(lambda: Owner().outer(), 2)
    assert stages["inner"].kernels == stages["outer"].kernels + 2
    assert stages["inner"].at_best > stages["outer"].at_best > 0 and stages[step_profile.REST].kernels == 0
    assert dr.thread_count() == threads
    assert "inner" in step_profile.table(stages).splitlines()[1] + step_profile.table(stages).splitlines()[2]
