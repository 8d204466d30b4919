# again.sh COMMAND...: pytest; where one test of thousands has failed, or two, these are tried once
# more, each alone and with nothing beside it. A machine whose cores are taken away for seconds may
# fail one of them; a fault does so again. What failed is printed whole, and named in the last lines
# of the run: it is to be looked into. An attack that succeeds once has succeeded,
# and a result that is wrong once is wrong.
set -uo pipefail
"$@"
code=$?
[ "$code" = 1 ] || exit "$code"
failed=.pytest_cache/v/cache/lastfailed
names=$(sed -n 's/^ *"\(.*\)": true,*$/\1/p' "$failed" | grep -v '^$')
attacks='attack|lies|stranger|hostile|attribution'
if [ -z "$names" ] || [ "$(wc -l <<<"$names")" -gt 2 ] || grep -qE "$attacks" <<<"$names"; then
  exit 1
fi
printf '\n======== failed, and tried again:\n%s\n' "$names"
"$@" -n 0 --last-failed || exit 1
while IFS= read -r name; do
  printf 'FAILED ONCE, passed alone: %s\n' "$name"
done <<<"$names"
