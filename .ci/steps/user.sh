# As a plain user, who has no right to anything here: what confines and what is confined.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
if [ "$(id -u)" != 0 ]; then
  echo "all of this has run as a plain user already"
  exit 0
fi
uid=$(($(awk -F: '$3 < 60000 && $3 > max {max = $3} END {print max}' /etc/passwd) + 1000))
# Debian's own interpreter: those of root's pyenv lie below /root, which is closed to others.
make_venv /usr/bin/python3 "$CI_WORK/user"
bin=$CI_WORK/user/bin
"$bin/uv" pip install --quiet --python "$bin/python" "$(wheel)" --group test
copy_tests "$CI_WORK/user/checkout"
mkdir "$CI_WORK/user/home"
chown -R "$uid:$uid" "$CI_WORK/user/checkout" "$CI_WORK/user/home"
cd "$CI_WORK/user/checkout"
with_summary user setpriv --reuid "$uid" --regid "$uid" --clear-groups --inh-caps -all \
  env -i HOME="$CI_WORK/user/home" PATH=/usr/bin:/bin LANG=C.UTF-8 CI=true \
  TMPDIR="$CI_WORK/user/home" \
  "$bin/python" -m pytest -n 2 --dist worksteal -p no:cacheprovider \
  tests/unit tests/integration tests/attacks
