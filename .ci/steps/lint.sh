# Style, and types of both packages. Proves that
# nothing is called that is not there, on any path.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
make_venv "$(find_python 3.11 || command -v python3)" "$CI_WORK/lint"
bin=$CI_WORK/lint/bin
"$bin/uv" pip install --quiet --python "$bin/python" '.[video,metrics]' --group lint
"$bin/uv" pip uninstall --quiet --python "$bin/python" envhub-sandbox

"$bin/ruff" check .
"$bin/ruff" format --check .

"$bin/mypy" --strict --config-file pyproject.toml \
  --cache-dir "$CI_WORK/mypy" -p envhub_sandbox -p envhub_worker
