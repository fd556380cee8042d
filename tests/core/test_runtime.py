"""Which LLVM is chosen, and what a person reads where none will do."""

import os
import subprocess
import sys

import pytest

from rgs_mi.core import runtime
from rgs_mi.core.errors import UserError


@pytest.fixture
def libraries(monkeypatch, tmp_path):
    """A machine with the given LLVM libraries, {name: version}, newest preferred, and nothing chosen yet."""
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)

    def install(versions):
        paths = {tmp_path / name: version for name, version in versions.items()}
        monkeypatch.setattr(runtime, "_candidates", lambda: iter(paths))
        monkeypatch.setattr(
            runtime, "llvm_version", lambda path: next((v for p, v in paths.items() if str(p) == str(path)), None)
        )
        return paths

    return install


def test_too_old_libraries_are_passed_over(libraries):
    libraries({"libLLVM-15.so": 15, "not-llvm.so": None, "libLLVM-19.so": 19, "libLLVM-16.so": 16})
    runtime.find_llvm()
    assert os.environ["DRJIT_LIBLLVM_PATH"].endswith("libLLVM-19.so")


def test_nothing_but_old_libraries_is_an_error_with_the_remedy(libraries):
    libraries({"libLLVM-14.so": 14, "libLLVM-15.so": 15})
    runtime.find_llvm()
    assert "DRJIT_LIBLLVM_PATH" not in os.environ
    with pytest.raises(UserError, match="no LLVM of version 16 or later .* install one .*karellen-llvm-core"):
        runtime.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize("version, message", [(15, "is LLVM 15, which is too old"), (None, "is not an LLVM library")])
def test_a_library_that_the_user_chose_is_respected_and_judged(libraries, monkeypatch, version, message):
    (path,) = libraries({"mine.so": version})
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(path))
    runtime.find_llvm()
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(path)
    with pytest.raises(UserError, match=message):
        runtime.set_variant("llvm_ad_rgb")


def test_unknown_variant():
    with pytest.raises(UserError, match="scalar_rgb.*llvm_ad_rgb"):
        runtime.set_variant("scalar_rgb")


def test_a_wrong_library_ends_a_script_in_one_line(tmp_path):
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    code = "import rgs_mi; from rgs_mi.core.errors import run_main; run_main(lambda: rgs_mi.set_variant('llvm_ad_rgb'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert [line for line in done.stderr.splitlines() if line.startswith("error:")] == [done.stderr.splitlines()[-1]]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a way to take cores away")
def test_one_core_reads_and_writes_exr_files(tmp_path):
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import rgs_mi; rgs_mi.set_variant('llvm_ad_rgb')\n"
        f"import mitsuba as mi, numpy as np; mi.Bitmap(np.ones((512, 512, 3), np.float32)).write(r'{tmp_path}/a.exr')\n"
        f"print(np.array(mi.Bitmap(r'{tmp_path}/a.exr')).mean())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "1.0", done.stderr


def test_peak_memory_in_the_unit_of_the_system(monkeypatch):
    resource = pytest.importorskip("resource")
    usage = type("Usage", (), {"ru_maxrss": 512 << 10})
    monkeypatch.setattr(resource, "getrusage", lambda who: usage)
    for platform, expected in {"linux": 512.0, "darwin": 0.5}.items():
        monkeypatch.setattr(sys, "platform", platform)
        assert runtime.peak_rss_mb() == expected
    monkeypatch.setitem(sys.modules, "resource", None)  # as on Windows
    assert runtime.peak_rss_mb() is None


def test_the_folder_of_caches_can_be_set(monkeypatch, tmp_path):
    monkeypatch.delenv(runtime.CACHE_VARIABLE, raising=False)
    assert runtime.cache_folder("priors").as_posix() == "data/priors"
    monkeypatch.setenv(runtime.CACHE_VARIABLE, str(tmp_path))
    assert runtime.cache_folder("priors") == tmp_path / "priors" and runtime.cache_folder() == tmp_path


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="needs Linux's /proc")
def test_freed_arrays_go_back_to_the_system():
    import drjit as dr
    import mitsuba as mi

    if not mi.variant().startswith("llvm"):
        pytest.skip("arrays lie in the GPU's memory")

    def resident():
        with open("/proc/self/statm") as stream:
            return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    arrays = [dr.arange(mi.Float, 1 << 22) + k for k in range(12)]  # of 17 MB
    dr.eval(arrays)
    dr.sync_thread()
    before = resident()
    del arrays
    runtime.release_memory()
    assert resident() < before - 150
