# Repositories around real packages, in an environment that has none of these: cold, warm, and without
# a network. Proves that make_env brings what a repository declares. More of them by hand:
# python -m benchmarks.packages
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
built=$(wheel)
python=$(find_python 3.11 || command -v python3)
[ "$(id -u)" != 0 ] || [ ! -x /usr/bin/python3 ] || python=/usr/bin/python3
make_venv "$python" "$CI_WORK/packages"
"$CI_WORK/packages/bin/uv" pip install --quiet --python "$CI_WORK/packages/bin/python" "$built"
"$CI_WORK/packages/bin/python" -m benchmarks.packages minigrid gym-pusht highway-env
