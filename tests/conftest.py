import pytest

import rgs_mi


@pytest.fixture(autouse=True)
def variant():
    """Every test runs in the variant that the package is for; a test that changes it is put right again."""
    rgs_mi.set_variant("llvm_ad_rgb")
