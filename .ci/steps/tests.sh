# The README's command, with everything installed and no test skipped.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
export ENVHUB_CI=1 ENVHUB_TEST_DIR=$CI_WORK/tests
PYTHON=$(find_python 3.11 || command -v python3)
export PYTHON
permit_what_this_machine_lacks
with_summary tests ./test
