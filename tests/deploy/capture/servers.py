"""Stand-ins for motion capture servers, which send the documented bytes over the loopback.

NatNet: `PacketClient.cpp` and the packet's description of OptiTrack's NatNet SDK. Qualisys: "QTM Real-time
Server Protocol Documentation", version 1.25. Both are written without the packages under test.
"""

import socket
import struct
import threading
import time

import numpy as np

RATE_S = 0.005


class Scene:
    """Bodies and markers in the axes of the system, and what is wrong at present.

    `bodies`: name -> position (3,) [m] and axes (3, 3). `hidden`: names of lost bodies. `unnamed`: bodies in
    frames that the system does not describe. `held`: frames are made, but sent only once this is over.
    `mute`: no frames at all.
    """

    def __init__(self, bodies, markers=()):
        self.bodies, self.markers = bodies, np.array(markers, float).reshape(-1, 3)
        self.hidden, self.unnamed, self.held, self.mute = set(), set(), False, False


class Server:
    """A thread that makes a frame each `RATE_S`."""

    def __init__(self, scene):
        self.scene, self.ends, self.began = scene, threading.Event(), time.monotonic()
        self.thread = threading.Thread(target=self.serve, daemon=True)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ends.set()
        self.thread.join()

    def frames(self):
        """Yield the frames that are due; those that were held come at once when this is over."""
        held = []
        for number in range(1_000_000):
            if self.ends.wait(RATE_S):
                return
            if not self.scene.mute:
                held.append(self.frame(number, time.monotonic() - self.began))
            if not self.scene.held:
                yield held
                held = []


def quaternion(axes):
    """x, y, z, w of a matrix, by its largest eigenvector (Bar-Itzhack)."""
    m = axes
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]


class NatNetServer(Server):
    """Motive: UDP, little-endian, metres, quaternions x, y, z, w."""

    CLOCK = 1e7  # ticks of the server's clock a second
    LATENCY_S = 0.004

    def __init__(self, scene, version=(3, 1), group=None):
        super().__init__(scene)
        self.version, self.group = version, group
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.0)
        self.port, self.clients = self.socket.getsockname()[1], set()
        if group:
            self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))

    def serve(self):
        with self.socket:
            for frames in self.frames():
                self.answer()
                for frame in frames:
                    for client in [self.group] if self.group else self.clients:
                        self.socket.sendto(frame, client)

    def answer(self):
        while True:
            try:
                data, client = self.socket.recvfrom(4096)
            except BlockingIOError:
                return
            asked = struct.unpack("<H", data[:2])[0]
            if asked == 0:  # connect
                self.clients.add(client)
                info = b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0]) + bytes([*self.version, 0, 0])
                info += struct.pack("<QHB4s", int(self.CLOCK), 1511, bool(self.group), b"\xef\xff\x2a\x63")
                self.socket.sendto(message(1, info), client)
            elif asked == 4:  # model definitions
                self.socket.sendto(message(5, self.described()), client)

    def sized(self, data):
        return (struct.pack("<i", len(data)) if self.version >= (4, 1) else b"") + data

    def many(self, items):
        return struct.pack("<i", len(items)) + self.sized(b"".join(items))

    def described(self):
        names = b"".join(b"m%d\0" % k for k in range(len(self.scene.markers)))
        sets = [(0, b"arm\0" + struct.pack("<i", len(self.scene.markers)) + names)]
        for number, name in enumerate(self.scene.bodies, 7):
            if name in self.scene.unnamed:
                continue
            body = name.encode() + b"\0" + struct.pack("<ii3f", number, -1, 0.0, 0.0, 0.0)
            body += struct.pack("<i3fi", 1, 0.01, 0.0, 0.0, 0)  # one marker of its own, and its label
            sets.append((1, body + (b"m\0" if self.version >= (4, 0) else b"")))
        return struct.pack("<i", len(sets)) + b"".join(
            struct.pack("<i", kind) + self.sized(data) for kind, data in sets
        )

    def frame(self, number, time_s):
        scene, exposed = self.scene, int(self.CLOCK * time_s)
        bodies = []
        for key, (name, (at_m, axes)) in enumerate(scene.bodies.items(), 7):
            seen = name not in scene.hidden
            pose = (*at_m, *quaternion(axes)) if seen else np.zeros(7)
            bodies.append(struct.pack("<i7ffh", key, *pose, 1e-4, seen))
        markers = np.nan_to_num(scene.markers)
        sets = [b"arm\0" + struct.pack("<i", len(markers)) + markers.astype("<f4").tobytes()]
        sets.append(b"all\0" + struct.pack("<i3f", 1, 9.0, 9.0, 9.0))
        labelled = [struct.pack("<i4fhf", 1, 9.0, 9.0, 9.0, 0.01, 0, 1e-4)]
        data = struct.pack("<i", number) + self.many(sets) + self.many([struct.pack("<3f", 8.0, 8.0, 8.0)])
        data += self.many(bodies) + self.many([])  # skeletons
        data += self.many([]) if self.version >= (4, 1) else b""  # assets
        data += self.many(labelled) + self.many([]) + self.many([])  # force plates, devices
        sent = exposed + int(self.CLOCK * self.LATENCY_S)
        data += struct.pack("<IIdQQQh", 0, 0, time_s, exposed, exposed, sent, 0)
        return message(7, data + (bytes(8) if self.version >= (4, 1) else b"") + bytes(4))


def message(kind, data):
    return struct.pack("<HH", kind, len(data)) + data


class QualisysServer(Server):
    """QTM: TCP, little-endian, millimetres, matrices column by column, NaN for what is not seen."""

    def __init__(self, scene, port=0):
        super().__init__(scene)
        self.listener = socket.create_server(("127.0.0.1", port))
        self.listener.settimeout(0.01)
        self.port, self.client, self.streams = self.listener.getsockname()[1], None, False
        self.n_accepted, self.n_dropped, self.refuses = 0, 0, ""

    def serve(self):
        with self.listener:
            for frames in self.frames():
                if self.client is None:
                    self.accept()
                else:
                    self.answer()
                for frame in frames if self.streams else ():
                    self.send(3, frame)
        if self.client is not None:
            self.client.close()

    def accept(self):
        try:
            self.client = self.listener.accept()[0]
        except TimeoutError:
            return
        self.n_accepted += 1
        self.client.settimeout(1.0)
        self.send(1, b"QTM RT Interface connected\0")

    def send(self, kind, data):
        if self.client is None:
            return
        packet = struct.pack("<II", 8 + len(data), kind) + data
        try:  # in two parts, as they may come over a network
            self.client.sendall(packet[:11])
            self.client.sendall(packet[11:])
        except OSError:
            self.drop()

    def drop(self):
        self.client.close()
        self.client, self.streams, self.n_dropped = None, False, self.n_dropped + 1

    def answer(self):
        self.client.setblocking(False)
        try:
            data = self.client.recv(4096)
        except BlockingIOError:
            return
        except ConnectionResetError:
            data = b""
        finally:
            self.client.settimeout(1.0)
        if not data:
            self.drop()
        while data:
            size, _ = struct.unpack("<II", data[:8])
            self.command(data[8:size].rstrip(b"\0").decode().lower())
            data = data[size:]

    def command(self, text):
        if self.refuses and text.startswith(self.refuses):
            self.send(0, b"Parse error\0")
        elif text.startswith("version"):
            self.send(1, b"Version set to " + text.split()[1].encode() + b"\0")
        elif text.startswith("getparameters"):
            bodies = "".join(f"<Body><Name>{name}</Name></Body>" for name in self.scene.bodies)
            # The labels' order is not that of the numbers.
            labels = [f"arm{k}" for k in reversed(range(len(self.scene.markers)))] + ["other"]
            labels = "".join(f"<Label><Name>{name}</Name></Label>" for name in labels)
            xml = f"<The_6D>{bodies}</The_6D><The_3D><AxisUpwards>+Z</AxisUpwards>{labels}</The_3D>"
            self.send(2, f"<QTM_Parameters_Ver_1.25>{xml}</QTM_Parameters_Ver_1.25>\0".encode())
        elif text.startswith("streamframes"):
            self.streams = text != "streamframes stop"

    def frame(self, number, time_s):
        scene = self.scene
        poses = [
            np.append(1e3 * np.array(at_m), np.ravel(axes, order="F"))
            * (np.nan if name in scene.hidden else 1)
            for name, (at_m, axes) in scene.bodies.items()
        ]
        six = struct.pack("<ihh", len(poses), 0, 0) + np.array(poses, "<f4").tobytes()
        markers = np.concatenate([1e3 * scene.markers[::-1], [[9.0, 9.0, 9.0]]])
        three = struct.pack("<Ihh", len(markers), 0, 0) + markers.astype("<f4").tobytes()
        parts = [struct.pack("<II", 8 + len(part), kind) + part for kind, part in ((5, six), (1, three))]
        return struct.pack("<qII", int(1e6 * time_s), number, len(parts)) + b"".join(parts)
