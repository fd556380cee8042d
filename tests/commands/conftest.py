"""What tests of suites share."""

import pytest

from rgs_mi.commands import ablate, jobs
from rgs_mi.core.errors import UserError


@pytest.fixture
def inside(monkeypatch, tmp_path):
    """Fits run in this process, and are noted, as SCENE/VARIANT."""
    fitted = []

    def each(function, calls, workers):
        for arguments in calls:
            try:
                yield arguments, function(*arguments), None
            except UserError as error:
                yield arguments, None, error

    def fit(xml, job, quiet):
        fitted.append(f"{job.scene}/{job.variant}")
        return fit_job(xml, job, quiet)

    fit_job = jobs.fit
    monkeypatch.chdir(tmp_path)  # where what is known of depths is kept
    monkeypatch.setattr(jobs, "each_apart", each)
    monkeypatch.setattr(jobs, "fit", fit)
    monkeypatch.setattr(ablate, "apart", lambda function, *arguments: function(*arguments))
    return fitted
