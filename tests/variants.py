"""The variant that tests run in."""

import os

VARIANT = os.environ.get("RGS_MI_VARIANT", "llvm_ad_rgb")
