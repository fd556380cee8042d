#!/usr/bin/env bash
# What the package does on a GPU, in eight minutes and one table:
#
#     scripts/gpu_check.sh [OUT]        (default: runs/gpu_check)
#
# Installs the clone beside what the machine's Python has, from the folder `wheels` where there is one, which needs no network
# (`pip download -d wheels . pytest pytest-xdist setuptools wheel` fills it), runs the tests of kernels, both benchmarks and two
# minutes of the helmet in `cuda_ad_rgb`, or in the variant that RGS_MI_VARIANT names, and ends with 1 where one of them fails.
# OUT has what they print.
set -uo pipefail
cd "$(dirname "$0")/.."
export RGS_MI_VARIANT=${RGS_MI_VARIANT:-cuda_ad_rgb}
out=${1:-runs/gpu_check}
mkdir -p "$out"
rows=()

# stage NAME SECONDS PATTERN COMMAND…: the last line of its output that matches goes into the table
stage() {
    local name=$1 most=$2 pattern=$3 start=$SECONDS state=ok
    shift 3
    echo "== $name" >&2
    timeout "$most" "$@" >"$out/$name.log" 2>&1 || state="failed ($?)"
    [ "$state" = ok ] || tail -n 5 "$out/$name.log" >&2
    rows+=("$(printf '%-8s  %-12s %4d s  %s' "$name" "$state" $((SECONDS - start)) "$(grep -aE "$pattern" "$out/$name.log" | tail -n 1)")")
}

offline=""
[ -d wheels ] && offline="--no-index --find-links wheels"
venv=$out/venv
stage install 150 . bash -c "python3 -m venv '$venv' \
    && python3 -c 'import sys; print(*(p for p in sys.path if \"-packages\" in p), sep=chr(10))' >\$(echo '$venv'/lib/python3*/site-packages)/machine.pth \
    && '$venv'/bin/python -m pip install --quiet $offline -e . pytest pytest-xdist"
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null
stage tests 180 'passed|failed' "$venv"/bin/python -m pytest -q -n 8 --dist worksteal -o filterwarnings= tests/splat \
    tests/shading/test_split_sum.py tests/fit/test_losses.py tests/fit/test_density.py tests/fit/test_trainer.py
stage splat 60 '^total' "$venv"/bin/python scripts/benchmark.py splat --variant "$RGS_MI_VARIANT"
stage step 90 'ms a step' "$venv"/bin/python scripts/benchmark.py step --data ball --variant "$RGS_MI_VARIANT"
stage helmet 300 '^PSNR' "$venv"/bin/python scripts/optimize.py scenes/helmet.xml --minutes 2 --out "$out/helmet" --variant "$RGS_MI_VARIANT" --quiet

printf '%s\n' "" "${rows[@]}"
! printf '%s\n' "${rows[@]}" | grep -q failed
