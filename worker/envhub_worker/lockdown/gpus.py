"""The GPUs of a host, and the device nodes and folders of /sys that a jail gets for them. Pure.

A jail gets the nodes for computing and rendering: ``nvidiaN``, ``renderD*``, and ``nvidiactl``,
``nvidia-uvm`` and ``kfd``, through which a driver reaches every GPU whose own node can be opened.
It gets no display (``card*``, ``nvidia-modeset``) and no profiler (``nvidia-uvm-tools``).
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Collection

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.root_plan import HostFiles, resolve
from envhub_worker.protocol.records import dataclass

_ADDRESS = re.compile(r"[0-9a-f]{4,8}:[0-9a-f]{2}:[0-9a-f]{2}\.[0-7]")
_NVIDIA = re.compile(r"nvidia\d+")
_RENDER = re.compile(r"renderD\d+")
_MINOR = re.compile(r"Device Minor:\s*(\d+)")
_NVIDIAS = "/proc/driver/nvidia/gpus"
_NVIDIAS_SHARED = ("/dev/nvidiactl", "/dev/nvidia-uvm")
_KFD, _KFD_FOLDER = "/dev/kfd", "/sys/class/kfd/kfd"


@dataclass(frozen=True)
class GpuGrant:
    """Device nodes and folders for a jail. ``folders``: paths of /sys; their links are followed."""

    devices: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()


def gpu_devices(host: HostFiles) -> tuple[str, ...]:
    """The device nodes of all GPUs."""
    return _granted(gpus(host), host).devices


def granted(gpu: bool | tuple[int, ...], host: HostFiles) -> GpuGrant:
    """Returns the grant for ``gpu`` on this host: no GPU, all GPUs, or those of some indices.
    Raises ``LayerUnavailableError``: there is no such GPU. Without this error a program would only
    fail later, or fall back to the CPU.
    """
    if gpu is False:
        return GpuGrant()
    devices = gpus(host)
    wanted = range(len(devices)) if gpu is True else gpu
    if not devices:
        raise LayerUnavailableError(
            "gpu",
            "the policy grants the GPU, and there is none here: no /dev/dri/renderD* and no "
            "/dev/nvidia0",
            "Install its driver, or give it to the container (docker run --gpus all), or grant "
            "no GPU.",
        )
    missing = [index for index in wanted if index >= len(devices)]
    if missing:
        available = "; ".join(f"{index}: {' '.join(nodes)}" for index, nodes in enumerate(devices))
        raise LayerUnavailableError(
            "gpu",
            f"the policy grants GPU {missing[0]}, which does not exist here; these do: {available}",
            "Grant some of these.",
        )
    return _granted([devices[index] for index in wanted], host)


def gpus(host: HostFiles) -> list[tuple[str, ...]]:
    """The nodes of each GPU: NVIDIA's first, in the order of ``nvidia-smi``, by PCI address."""
    nvidias = [f"/dev/{name}" for name in host.listdir("/dev") if _NVIDIA.fullmatch(name)]
    renders = [name for name in host.listdir("/dev/dri") if _RENDER.fullmatch(name)]
    by_device: dict[str, list[str]] = {}
    for node in (*sorted(nvidias), *sorted(f"/dev/dri/{name}" for name in renders)):
        by_device.setdefault(_address(node, host) or node, []).append(node)

    def place(device: str) -> tuple[bool, bool, list[str | int]]:
        is_nvidias = any(_is_nvidias(node) for node in by_device[device])
        number = [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", device)]
        return not is_nvidias, device.startswith("/"), [device] if ":" in device else number

    return [tuple(by_device[device]) for device in sorted(by_device, key=place)]


def _is_nvidias(node: str) -> bool:
    return node.startswith("/dev/nvidia")


def _address(node: str, host: HostFiles) -> str:
    """The PCI address of the GPU that a device node belongs to; empty if unknown."""
    name = posixpath.basename(node)
    if not _is_nvidias(node):
        folder = resolve(f"/sys/class/drm/{name}", host, {})
        addresses: list[str] = _ADDRESS.findall(folder)
        return addresses[-1] if addresses else ""
    for address in host.listdir(_NVIDIAS):
        minor = _MINOR.search(host.read(f"{_NVIDIAS}/{address}/information"))
        if minor is not None and name == f"nvidia{minor[1]}" and _ADDRESS.fullmatch(address):
            return address
    return ""


def _granted(chosen: Collection[tuple[str, ...]], host: HostFiles) -> GpuGrant:
    own = [node for nodes in chosen for node in nodes]
    shared = [*_NVIDIAS_SHARED] if any(map(_is_nvidias, own)) else []
    is_amds = any(not any(map(_is_nvidias, nodes)) for nodes in chosen)
    shared += [_KFD] if is_amds else []
    folders = [folder for node in own for folder in _folders(node, host)]
    folders += [_KFD_FOLDER] if is_amds else []
    devices = [*own, *(node for node in shared if host.exists(node))]
    return GpuGrant(tuple(sorted(devices)), tuple(sorted(set(folders))))


def _folders(node: str, host: HostFiles) -> list[str]:
    """Paths in /sys under which drivers look up the GPU of this device node."""
    address = _address(node, host)
    folders = [f"/sys/bus/pci/devices/{address}"] if address else []
    if not _is_nvidias(node):
        name = posixpath.basename(node)
        number = host.read(f"/sys/class/drm/{name}/dev").strip()
        folders += [f"/sys/class/drm/{name}", f"/sys/dev/char/{number}"] if number else []
    return folders
