# The pages of `envhub check`, of hostile repositories, in Chromium: nothing in them runs and nothing is
# loaded, and where nothing is escaped all of it does. And every page of the site, where the step "site"
# has built it. Where there is no Chromium and none can be installed, this says so and proves nothing.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
found() { command -v chromium-headless-shell || command -v chromium; }
get() {
  export DEBIAN_FRONTEND=noninteractive
  local words=(install -y --no-install-recommends chromium-headless-shell)
  apt-get -qq "${words[@]}" >/dev/null || { apt-get -qq update && apt-get -qq "${words[@]}" >/dev/null; }
}
if ! found && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
  patiently get || true
fi
if ! found >/dev/null; then
  echo "no Chromium could be had: no page was opened" | tee "$CI_WORK/browser.summary"
  exit 0
fi

# What the step "tests" installed serves here too.
made=$CI_WORK/tests
if [ ! -x "$made/venv/bin/python" ]; then
  made=$CI_WORK/browser
  python=$(find_python 3.11 || command -v python3)
  [ "$(id -u)" != 0 ] || [ ! -x /usr/bin/python3 ] || python=/usr/bin/python3
  make_venv "$python" "$made/venv"
  install=("$made/venv/bin/uv" pip install --quiet --python "$made/venv/bin/python")
  "${install[@]}" "$(wheel)[video]"
  "${install[@]}" --group test
  copy_tests "$made/checkout"
fi
options=()
[ ! -d "$CI_WORK/site/built" ] || options=(--site "$CI_WORK/site/built")
cd "$made/checkout"
"$made/venv/bin/python" -m tests.browser "${options[@]}"
