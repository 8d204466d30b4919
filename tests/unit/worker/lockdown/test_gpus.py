"""Which GPUs a host has, and what of them a jail is given, over hosts that are made up."""

import posixpath

import pytest

from envhub_worker.lockdown.gpus import GpuGrant, gpu_devices, gpus, granted
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.root_plan import HostFiles, plan_root

PCI = "/sys/devices/pci0000:00"
DEV = """
    null zero nvidia0 nvidia1 nvidia10 nvidiactl nvidia-modeset nvidia-uvm nvidia-uvm-tools
    nvidia-caps nvidia-nvswitch0 kfd sda kvm
"""


def host(
    dev: str = DEV,
    dri: str = "",
    minors: dict[str, int] | None = None,
    renders: dict[str, str] | None = None,
) -> HostFiles:
    """A host with these nodes in /dev and /dev/dri; NVIDIA's driver gives minor numbers to PCI
    addresses, and render nodes have folders of devices."""
    listings = {
        "/dev": dev.split(),
        "/dev/dri": dri.split(),
        "/proc/driver/nvidia/gpus": list(minors or {}),
    }
    files = {
        f"/proc/driver/nvidia/gpus/{address}/information": f"Model: X\nDevice Minor: \t {minor}\n"
        for address, minor in (minors or {}).items()
    }
    links = {f"/sys/bus/pci/devices/{address}": f"{PCI}/{address}" for address in minors or {}}
    for number, (name, folder) in enumerate((renders or {}).items()):
        files[f"/sys/class/drm/{name}/dev"] = f"226:{128 + number}\n"
        links[f"/sys/class/drm/{name}"] = links[f"/sys/dev/char/226:{128 + number}"] = (
            f"{folder}/drm/{name}"
        )
        address = posixpath.basename(folder)
        links[f"/sys/bus/pci/devices/{address}"] = folder
    there = {f"/dev/{name}" for name in dev.split()} | {f"/dev/dri/{name}" for name in dri.split()}
    folders = {*links.values(), "/sys/class/kfd/kfd", "/sys/class/net", "/sys/devices"}
    return HostFiles(
        exists=lambda path: path in there | folders,
        readlink=links.get,
        listdir=lambda path: listings.get(path, []),
        read=lambda path: files.get(path, ""),
    )


SERVER = host(
    dri="card0 card1 by-path renderD128 renderD129 renderD130",
    minors={"0000:c1:00.0": 0, "0000:01:00.0": 1, "0000:41:00.0": 10},
    renders={
        "renderD128": f"{PCI}/0000:00:02.0",
        "renderD129": f"{PCI}/0000:00:01.0/0000:01:00.0",
        "renderD130": f"{PCI}/0000:00:03.0/0000:c1:00.0",
    },
)
"""Three of NVIDIA's, of which two can draw, and one in the processor."""


def test_gpus_are_counted_as_nvidia_smi_does() -> None:
    assert gpus(SERVER) == [
        ("/dev/nvidia1", "/dev/dri/renderD129"),
        ("/dev/nvidia10",),
        ("/dev/nvidia0", "/dev/dri/renderD130"),
        ("/dev/dri/renderD128",),
    ]


def test_without_addresses_gpus_are_counted_by_their_nodes() -> None:
    assert gpus(host()) == [("/dev/nvidia0",), ("/dev/nvidia1",), ("/dev/nvidia10",)]
    assert gpus(host(dev="", dri="renderD129 renderD128")) == [
        ("/dev/dri/renderD128",),
        ("/dev/dri/renderD129",),
    ]


def test_all_is_what_computes_and_renders() -> None:
    assert (
        gpu_devices(SERVER)
        == granted(True, SERVER).devices
        == (
            *("/dev/dri/renderD128", "/dev/dri/renderD129", "/dev/dri/renderD130", "/dev/kfd"),
            *("/dev/nvidia-uvm", "/dev/nvidia0", "/dev/nvidia1", "/dev/nvidia10", "/dev/nvidiactl"),
        )
    )


def test_a_chosen_gpu_is_its_own_nodes_and_folders() -> None:
    assert granted((0,), SERVER) == GpuGrant(
        ("/dev/dri/renderD129", "/dev/nvidia-uvm", "/dev/nvidia1", "/dev/nvidiactl"),
        ("/sys/bus/pci/devices/0000:01:00.0", "/sys/class/drm/renderD129", "/sys/dev/char/226:129"),
    )
    assert granted((3,), SERVER) == GpuGrant(
        ("/dev/dri/renderD128", "/dev/kfd"),
        (
            *("/sys/bus/pci/devices/0000:00:02.0", "/sys/class/drm/renderD128"),
            *("/sys/class/kfd/kfd", "/sys/dev/char/226:128"),
        ),
    )
    both = set(granted((0,), SERVER).devices) | set(granted((3,), SERVER).devices)
    assert set(granted((0, 3), SERVER).devices) == both


def test_of_sys_a_jail_sees_the_devices_own_folders() -> None:
    """By the names that drivers look under, and with nothing above: no list of network devices."""
    gpu = granted((0,), SERVER)
    plan = plan_root(
        *((), gpu.folders, ()), private=(), devices=gpu.devices, network="none", host=SERVER
    )
    folder = f"{PCI}/0000:00:01.0/0000:01:00.0"
    assert [path for path in plan.trees if path.startswith("/sys")] == [folder]
    assert {path: to for path, to in plan.links.items() if path.startswith("/sys")} == {
        "/sys/bus/pci/devices/0000:01:00.0": folder,
        "/sys/class/drm/renderD129": f"{folder}/drm/renderD129",
        "/sys/dev/char/226:129": f"{folder}/drm/renderD129",
    }


def test_what_a_device_in_a_device_is_part_of_is_its_folder() -> None:
    """A virtual machine's GPU is a virtio device on PCI: drivers read the address above."""
    virtual = host("", "renderD128", renders={"renderD128": f"{PCI}/0000:00:05.0/virtio3"})
    assert "/sys/bus/pci/devices/0000:00:05.0" in granted(True, virtual).folders


def test_nothing_is_granted_unasked() -> None:
    assert granted(False, SERVER) == GpuGrant()


@pytest.mark.parametrize("gpu", [True, (0,)])
def test_a_gpu_where_there_is_none_is_refused(gpu: bool | tuple[int, ...]) -> None:
    with pytest.raises(LayerUnavailableError, match="there is none here"):
        granted(gpu, host(dev="nvidiactl nvidia-uvm kfd", dri="card0"))


def test_an_index_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(LayerUnavailableError, match=r"GPU 4, .* 1: /dev/nvidia10; 2: "):
        granted((0, 4), SERVER)
