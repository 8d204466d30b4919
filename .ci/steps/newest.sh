# The newest interpreter and the newest dependencies.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
smoke newest "$(find_python 3.13)"
