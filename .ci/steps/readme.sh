# What a newcomer does: both of the README's commands, word for word, in a clean copy, with the
# python3 that is first on the PATH; then the tests once more as a plain user, with the system's python3.
# Proves that they pass for both, whatever root's interpreter is, and that what cannot be tested
# there is skipped. Of each test of the short form one case; of the plain user's none that the step
# "user" has, with the same interpreter, and of the parity of results one environment.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
unset PYTHON "${!ENVHUB_@}"
export ENVHUB_TEST_RUNNER="bash $CI_AGAIN"
mapfile -t commands < <(awk '/^```sh$/ {inside = 1; next} /^```$/ {inside = 0} inside' README.md | grep -E '^(python3|\./test)')

# newcomer NAME PREFIX...: in a copy of the checkout. A plain user's tests install what the first command does.
newcomer() {
  local name=$1
  shift
  cp -R . "$CI_WORK/$name"
  (
    cd "$CI_WORK/$name"
    echo "$name, with $("$@" bash -c 'command -v python3')"
    if [ "$name" = readme ]; then
      echo "\$ ${commands[0]}"
      "$@" bash -euo pipefail -c "${commands[0]}"
      test -s cartpole.mp4
    fi
    echo "\$ ${commands[1]}"
    with_summary "$name" "$@" bash -euo pipefail -c "${commands[1]}"
  )
}

if [ "$(id -u)" != 0 ]; then
  newcomer readme env ENVHUB_CACHE="$CI_WORK/readme-cache"
  exit 0
fi
# both side by side: they are two users, and much of an installation is waiting
proved_elsewhere=(--ignore=tests/{attacks,integration/confinement} --deselect=tests/compliance/test_parity.py::TestCartPole)
(newcomer readme-user bash "$CI_STEPS/../as-user.sh" 0 \
  env "PYTEST_ADDOPTS=--one-case ${proved_elsewhere[*]}") >"$CI_WORK/readme-user.out" 2>&1 &
user=$!
(newcomer readme env ENVHUB_CACHE="$CI_WORK/readme-cache" \
  PYTEST_ADDOPTS="--one-case") &
root=$!
failed=0
wait "$root" || failed=1
wait "$user" || failed=1
cat "$CI_WORK/readme-user.out"
exit "$failed"
