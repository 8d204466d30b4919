# As a plain user, who has no right to anything here: what confines and what is confined. The
# interpreter is Debian's own: those of root's pyenv lie below /root, which is closed to others.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
if [ "$(id -u)" != 0 ]; then
  echo "all of this has run as a plain user already"
  exit 0
fi
permit_what_this_machine_lacks
export ENVHUB_TEST_DIR=$CI_WORK/user PYTHON=/usr/bin/python3
export ENVHUB_TEST_RUNNER="bash $CI_STEPS/../as-user.sh"
# One process: some limits count what a user runs, and two would count each other's.
# What downloads, what trains, how loading fails, what comes out of shared memory and what the client
# is told does not depend on who runs it, and has been run.
with_summary user ./test -n 1 tests/integration tests/attacks tests/unit/test_spawner.py \
  --ignore-glob='*/test_hub_*' --ignore-glob='*/test_dropin_*' --ignore-glob='*/test_loading*' \
  --ignore-glob='*/test_borrowed*' --ignore-glob='*/test_lane_*' --ignore-glob='*/test_validation*' \
  --ignore-glob='*/test_client_lies*' --ignore-glob='*/test_decoder_*' --ignore-glob='*/test_slabs*'
