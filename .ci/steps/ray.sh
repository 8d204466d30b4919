# Worker servers on a Ray cluster of several nodes, all on this machine: where they are placed, that
# results are those of any other place, and that nothing is left of what a killed actor, node, driver
# or head had. Ray is an extra of hundreds of megabytes, so no other step has it.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
python=$(find_python 3.11 || command -v python3)
[ "$(id -u)" != 0 ] || [ ! -x /usr/bin/python3 ] || python=/usr/bin/python3
built=$(wheel)
make_venv "$python" "$CI_WORK/ray"
if ! install_into "$CI_WORK/ray" "$built[ray]"; then
  echo "Ray cannot be installed here, and its tests are not run" | tee "$CI_WORK/ray.summary"
  exit 0
fi
install_into "$CI_WORK/ray" --group short
copy_tests "$CI_WORK/ray/checkout"
cd "$CI_WORK/ray/checkout"
export ENVHUB_CI=1 RAY_USAGE_STATS_ENABLED=0
with_summary ray bash "$CI_AGAIN" "$CI_WORK/ray/bin/python" -m pytest -n 1 -m short tests/remote/ray
