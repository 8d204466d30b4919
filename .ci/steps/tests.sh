# Every test, with everything installed and none skipped, as root or as whoever runs this. Proves
# what the documents say; containers are another step.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
export ENVHUB_CI=1 ENVHUB_TEST_DIR=$CI_WORK/tests ENVHUB_TEST_UV=$CI_UV
# Root's jails run as another user. Debian's own interpreter is one that all users may read, which
# the profiles without a private root need; root's pyenv lies below /root, closed to others.
PYTHON=$(find_python 3.11 || command -v python3)
[ "$(id -u)" != 0 ] || [ ! -x /usr/bin/python3 ] || PYTHON=/usr/bin/python3
export PYTHON PATH=$PATH:$CI_WORK/unpacked/usr/bin  # a Prometheus, where the step "system" got one
permit_what_this_machine_lacks
command -v prometheus >/dev/null || export ENVHUB_CI_WITHOUT_PROMETHEUS=1
# The step "container" has those that need an engine.
# Ray is in the step "ray".
export PYTEST_ADDOPTS="--ignore=tests/containers --ignore=tests/remote/ray --durations=40"  # the next minutes to save are there
export ENVHUB_ATTACK_TABLE=$CI_WORK/attacks.md  # every attack; docs/attacks.md is a summary
export ENVHUB_TEST_RUNNER="bash $CI_AGAIN"
with_summary tests ./test --full -n "$(processes)"
