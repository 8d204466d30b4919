# The README's command, with everything installed and no test skipped.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
export ENVHUB_CI=1 ENVHUB_TEST_DIR=$CI_WORK/tests
PYTHON=$(find_python 3.11 || command -v python3)
export PYTHON
if ! ls ${PIP_FIND_LINKS:-/nowhere}/torch-*.whl >/dev/null 2>&1; then
  echo "no torch build without CUDA in PIP_FIND_LINKS: its tests are skipped, and only those"
  export ENVHUB_CI_WITHOUT_TORCH=1
fi
with_summary tests ./test
