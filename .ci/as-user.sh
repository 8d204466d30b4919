# as-user.sh NUMBER COMMAND...: runs it in the current folder as a plain user, another one for each
# NUMBER, that owns just this folder and a home, with an environment of its own: of the caller's it
# has what CI permits, and pip's settings. To be run as root.
set -euo pipefail
taken=$(awk -F: '$3 < 60000 && $3 > max {max = $3} END {print max}' /etc/passwd)
uid=$((taken + 1000 + $1))
home=$CI_WORK/home-$1
shift
mkdir -p "$home"
chown -R "$uid:$uid" "$PWD" "$home"
kept=()
for name in "${!ENVHUB_CI@}" ENVHUB_TEST_RUNNER "${!PIP_@}"; do
  [ -z "${!name+set}" ] || kept+=("$name=${!name}")
done
exec setpriv --reuid "$uid" --regid "$uid" --clear-groups --inh-caps=-all \
  env -i HOME="$home" TMPDIR="$home" PATH=/usr/bin:/bin LANG=C.UTF-8 CI=true "${kept[@]}" "$@"
