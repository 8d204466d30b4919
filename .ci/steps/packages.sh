# Environments of strangers by their reference alone, or by the advice of their errors, in an environment
# that has none of these; and equal to the same in an ordinary one. All of them by hand:
# python -m benchmarks reach
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
built=$(wheel)
python=$(find_python 3.11 || command -v python3)
[ "$(id -u)" != 0 ] || [ ! -x /usr/bin/python3 ] || python=/usr/bin/python3
make_venv "$python" "$CI_WORK/packages" --compile-bytecode "$built"
"$CI_WORK/packages/bin/python" -m benchmarks.reach --quick
