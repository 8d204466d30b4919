# What tests need of the operating system: git for the Hub, GL for mujoco and OpenCV, Xvfb for
# displays, venv for the plain user, a cable to another network namespace, a Prometheus that is unpacked and not
# installed, as its package would start one. With no right to install, the tests themselves say what
# is missing.
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
packages=(git iproute2 iptables python3-venv libegl1 libgl1 libglib2.0-0 libosmesa6 xvfb)
missing=()
for package in "${packages[@]}"; do
  dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' ||
    missing+=("$package")
done
echo "missing: ${missing[*]:-nothing}"
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo "not root, or no apt-get: go on without them"
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
get=(apt-get -qq)
if [ ${#missing[@]} -gt 0 ]; then
  patiently "${get[@]}" update
  patiently "${get[@]}" install -y --no-install-recommends "${missing[@]}" >/dev/null
fi
mkdir "$CI_WORK/unpacked"
cd "$CI_WORK/unpacked"
download() {
  "${get[@]}" -o APT::Sandbox::User=root download "$1" && dpkg-deb --extract "$1"_*.deb .
}
download prometheus || { patiently "${get[@]}" update && patiently download prometheus; } ||
  echo "no prometheus: go on without it"
