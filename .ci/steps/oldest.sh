# The oldest interpreter and the oldest dependencies that pyproject.toml permits, and the same
# tests. Proves that what it permits is true.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
smoke oldest "$(find_python 3.10)" --resolution lowest-direct
