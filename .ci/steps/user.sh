# As a plain user, who has no right to anything here: what confines and what is confined, a case of
# each. Proves that nothing of it needs root. The
# interpreter is Debian's own: those of root's pyenv lie below /root, which is closed to others.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
if [ "$(id -u)" != 0 ]; then
  echo "all of this has run as a plain user already"
  exit 0
fi
permit_what_this_machine_lacks
export ENVHUB_CI=1 ENVHUB_CI_WITHOUT_CGROUPS=1
unset ENVHUB_TEST_DIR  # each part has its own
export PYTHON=/usr/bin/python3

# Every kind of attack on jails, under each profile, and what opens or starts something as the user who
# runs it. What the client makes of answers, of archives and of names is the same for all.
tests=(tests/attacks/{files,kernel,network,processes,resources,runner})
tests+=(tests/attacks/packages/test_{builds,packages}.py)
tests+=(tests/integration/confinement tests/integration/lifecycle/test_{lingering,odd_starts}.py)
tests+=(tests/integration/packages/test_builds.py)
tests+=(tests/unit/worker/{lockdown,spawn,access/store,test_file_access.py})
tests+=(tests/unit/client/{system/test_{folders,locks,processes}.py,hub/test_{store,local}.py,sources/test_checkout.py,sandboxes/test_{process,pool}.py})

# part NUMBER ARGUMENT...: these tests, by one process of a user of their own: some limits count what a
# user runs, and two processes would count each other's. What the step "tests" installed serves here
# too: it is the same interpreter.
part() {
  local number=$1
  local again=(bash "$CI_STEPS/../as-user.sh" "$number" bash "$CI_AGAIN")
  shift
  if checkout_of_tests "$CI_WORK/user-$number"; then
    cd "$CI_WORK/user-$number"
    with_summary "user-$number" "${again[@]}" "$CI_WORK/tests/venv/bin/python" -m pytest -n 1 \
      --one-case "$@"
  else
    cp -R . "$CI_WORK/user-$number"
    cd "$CI_WORK/user-$number"
    export ENVHUB_TEST_RUNNER="${again[*]}"
    with_summary "user-$number" ./test -n 1 --one-case "$@"
  fi
}

# More parts than a small machine has cores, as these tests wait for a third of their time. In the
# background: what is tested by && or || goes on after an error.
running=()
begin() {
  (part "$@") >"$CI_WORK/user-$1.out" 2>&1 &
  running+=($!)
}
for number in 0 1 2; do
  of_part=()
  for at in "${!tests[@]}"; do
    [ $((at % 3)) != $number ] || of_part+=("${tests[at]}")
  done
  begin $((number + 1)) "${of_part[@]}"
done
failed=0
for one in "${!running[@]}"; do
  wait "${running[one]}" || failed=1
  cat "$CI_WORK/user-$((one + 1)).out"
done
exit "$failed"
