# Style, spelling, locks, and types of both packages. Proves that
# nothing is called that is not there, on any path: of a client not even on macOS and Windows.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
make_venv "$(find_python 3.11 || command -v python3)" "$CI_WORK/lint" '.[video,metrics]' --group lint
bin=$CI_WORK/lint/bin
"$CI_UV" pip uninstall --quiet --python "$bin/python" envhub-sandbox

# the locks are what their command makes of pyproject.toml
cp -R .ci/locks "$CI_WORK/locks"
UV=$CI_UV .ci/lock.sh
diff -r .ci/locks "$CI_WORK/locks"

"$bin/ruff" check .
"$bin/ruff" format --check .
"$bin/codespell" . .ci  # a copy of the checkout, which is no repository

# side by side; a client needs nothing of Linux. Windows lacks whatever macOS lacks (but for names of
# Bluetooth, TCP_KEEPIDLE and EDEADLOCK), so macOS adds only what stands behind a test of the platform.
"$bin/mypy" --strict --config-file pyproject.toml \
  --cache-dir "$CI_WORK/mypy" -p envhub_sandbox -p envhub_worker &
running=($!)
elsewhere() {
  "$bin/mypy" --config-file .ci/elsewhere.ini --platform "$1" --cache-dir "$CI_WORK/mypy-$1" "${@:2}"
}
elsewhere win32 -p envhub_sandbox &
running+=($!)
mapfile -t platform_dependent < <(grep -rlw 'sys\.platform' envhub_sandbox worker/envhub_worker/protocol)
elsewhere darwin --follow-imports skip "${platform_dependent[@]}" &
running+=($!)
failed=0
for one in "${running[@]}"; do
  wait "$one" || failed=1
done
exit "$failed"
