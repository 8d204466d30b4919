# The newest interpreter and the newest dependencies: a case of each test of what they are asked for.
# Proves that a fresh installation works today.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
smoke newest "$(find_python 3.13)"
