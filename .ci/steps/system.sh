# What tests need of the operating system: git for the Hub, GL for mujoco and OpenCV, venv for
# the plain user, a cable to another network namespace. With no right to install, the tests
# themselves say what is missing.
packages=(git iproute2 iptables python3-venv libegl1 libgl1 libglib2.0-0 libosmesa6)
missing=()
for package in "${packages[@]}"; do
  dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' ||
    missing+=("$package")
done
echo "missing: ${missing[*]:-nothing}"
[ ${#missing[@]} -gt 0 ] || exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo "not root, or no apt-get: go on without them"
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
