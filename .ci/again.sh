# again.sh COMMAND...: pytest; each test that failed is run again, alone, three times, each time in a
# process of its own and with nothing beside it. If one of these runs fails, the command has failed.
# A machine whose cores are taken away for seconds may fail a test once; a fault fails again. What
# failed is printed whole, and named in the last lines of the run: it is to be mended.
# More than twenty are not run again: a slow moment fails a few tests of thousands, and twenty
# already cost some ten minutes.
set -uo pipefail
times=3 most=20
"$@"
code=$?
[ "$code" = 1 ] || exit "$code"  # 2 and above: interrupted, or it could not begin
failed=.pytest_cache/v/cache/lastfailed
mapfile -t names < <(sed -n 's/^ *"\(..*\)": true,*$/\1/p' "$failed")
[ "${#names[@]}" -gt 0 ] || exit 1
if [ "${#names[@]}" -gt "$most" ]; then
  printf '\n======== %s failed, which is too many to run them again\n' "${#names[@]}"
  exit 1
fi
printf '\n======== failed, and run again alone:\n'
printf '%s\n' "${names[@]}"
lines=() code=0
for name in "${names[@]}"; do
  line="FAILED ONCE, passed alone three times: $name"
  for _ in $(seq "$times"); do
    # pytest's own list of what failed, as JSON: the same command then runs this test and no other
    printf '{"%s": true}' "$name" >"$failed"
    "$@" -n 0 --last-failed && continue
    line="FAILED AGAIN: $name" code=1
    break
  done
  lines+=("$line")
done
printf '%s\n' "${lines[@]}"
exit $code
