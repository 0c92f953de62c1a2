"""The description of a run, and the ends of its channels in shared memory (iceoryx2)."""
import ctypes
import json
import os
import signal
import time

import numpy as np

from .wire import CODES, HEARTBEAT, MESSAGES, TYPES, WIRE, message

_PAYLOADS = {item["payload"]: item["name"] for item in WIRE["messages"]}
ROLES, STATES = CODES["role"], CODES["state"]
_PATIENCE_S = 20.0
_FAULT_REFUSED = 1


class Connection:
    """What connection.json says: `connection["time"]["step_ns"]`, and the numbers every message needs as attributes."""

    def __init__(self, description):
        if description.get("format") != "delmpc/connection/v1":
            raise ValueError(f"connection of format {description.get('format')!r}, this package knows delmpc/connection/v1")
        for service in description["services"]:
            ours = {item["payload"]: item["size"] for item in WIRE["messages"]}
            if ours.get(service["payload"]) != service["size"]:
                known = ", ".join(sorted(ours))
                raise ValueError(f"{service['channel']} carries {service['payload']} of {service['size']} bytes; this package knows "
                                 f"{known}: take the python/ folder of the same source as the delmpc command")
        self.description = description
        self.run_id = int(description["run_id"], 16)
        self.message_run_id = int(description["message_run_id"], 16)
        self.joint_set_hash = int(description["joint_set_hash"], 16)
        self.joints = description["robot"]["joints"]
        self.realtime = description["clock"] == "realtime"

    def __getitem__(self, key):
        return self.description[key]

    @classmethod
    def read(cls, path=None):
        """From a file, or from the one that DELMPC_CONNECTION names."""
        path = path or os.environ.get("DELMPC_CONNECTION")
        if not path:
            raise SystemExit("no run to connect to: start this by `delmpc run SCENARIO --plant '...'`, or set DELMPC_CONNECTION to a file "
                             "made by `delmpc wire --connection SCENARIO --run-id NAME`")
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))


def _payload(type_name, size):
    class Payload(ctypes.Structure):
        _fields_ = [("words", ctypes.c_uint64 * (size // 8))]

        @staticmethod
        def type_name():
            return type_name
    return Payload


class Node:
    """A process's place in the shared memory of a run. Keep it until all its ends are gone."""

    def __init__(self, connection):
        import iceoryx2 as iox2
        self.iox2, self.connection = iox2, connection
        iox2.set_log_level(iox2.LogLevel.Fatal)
        root = connection["shared_memory"]["root"]
        os.makedirs(os.path.dirname(root), mode=0o700, exist_ok=True)
        config = iox2.config.default()
        config.global_cfg.prefix = iox2.FileName.new(connection["shared_memory"]["prefix"])
        config.global_cfg.root_path = iox2.Path.new(root)
        config.global_cfg.creation_timeout = iox2.Duration.from_millis(100)
        builder = iox2.NodeBuilder.new().config(config).signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        self.node = self._insist(lambda: builder.create(iox2.ServiceType.Ipc), "the node")

    def _insist(self, attempt, what):
        begin = time.monotonic()
        while True:
            try:
                return attempt()
            except Exception as error:  # the binding has a class for each kind
                text = f"{type(error).__name__}: {error}"
                if any(word in text for word in ("Incompatible", "DoesNotSupportRequested")) or time.monotonic() - begin > _PATIENCE_S:
                    raise ConnectionError(f"{what} of run {self.connection['run_id']} cannot be opened: {text}; the other process has "
                                          "another payload, other settings or other joints (shared/messages/WIRE.md)") from error
            time.sleep(0.02)

    def _service(self, channel):
        iox2 = self.iox2
        settings = next(service for service in self.connection["services"] if service["channel"] == channel)
        payload = _payload(settings["payload"], settings["size"])
        attributes = iox2.AttributeVerifier.new()
        for key, value in settings["attributes"].items():
            attributes = attributes.require(iox2.AttributeKey.new(key), iox2.AttributeValue.new(value))

        def attempt():
            return (self.node.service_builder(iox2.ServiceName.new(settings["name"])).publish_subscribe(payload)
                    .enable_safe_overflow(settings["enable_safe_overflow"]).history_size(settings["history_size"])
                    .subscriber_max_buffer_size(settings["subscriber_max_buffer_size"])
                    .subscriber_max_borrowed_samples(settings["subscriber_max_borrowed_samples"])
                    .max_publishers(settings["max_publishers"]).max_subscribers(settings["max_subscribers"])
                    .max_nodes(settings["max_nodes"]).open_or_create_with_attributes(attributes))
        return payload, TYPES[_PAYLOADS[settings["payload"]]], self._insist(attempt, f"channel {channel}")

    def publisher(self, channel):
        return Publisher(*self._service(channel), insist=lambda attempt: self._insist(attempt, f"the sending end of {channel}"))

    def subscriber(self, channel):
        return Subscriber(*self._service(channel), insist=lambda attempt: self._insist(attempt, f"the receiving end of {channel}"))


class Publisher:
    """The sending end of a channel."""

    def __init__(self, payload, dtype, service, insist):
        self._payload, self._service = payload, service
        self._port = insist(lambda: service.publisher_builder().create())

    def send(self, one):
        """Sends an array of one message."""
        self._port.send_copy(self._payload.from_buffer_copy(one.tobytes()))

    def serve_newcomers(self):
        """Gives who came since the last message. Call it while you wait."""
        self._port.update_connections()


class Subscriber:
    """The receiving end of a channel."""

    def __init__(self, payload, dtype, service, insist):
        self._dtype, self._service = dtype, service
        self._port = insist(lambda: service.subscriber_builder().buffer_size(1).create())

    def latest(self):
        """The latest message that was not given out yet, or None."""
        found = None
        while True:
            sample = self._port.receive()
            if sample is None:
                break
            found = ctypes.string_at(sample.payload_ptr, self._dtype.itemsize)
            sample.delete()
        return None if found is None else np.frombuffer(found, self._dtype)[0]


class Member:
    """Signs of life, and what the others want: call `attend` in every turn of a loop."""

    def __init__(self, node, role):
        self.connection, self.other = node.connection, {"plant": "controller", "controller": "plant"}[role]
        self._beat = message("Heartbeat", node.connection.run_id, node.connection.joint_set_hash)
        self._beat[0]["role"], self._beat[0]["pid"] = ROLES[role.capitalize()], os.getpid()
        self._out = node.publisher(f"heartbeat-{role}")
        self._ears = {name: node.subscriber(f"heartbeat-{name}") for name in ("supervisor", self.other)}
        self.heard = dict.fromkeys(self._ears)
        self.supervised = "DELMPC_CONNECTION" in os.environ and os.environ.get("DELMPC_RUN_ID") == node.connection["run_id"]
        self._parent, self._told = os.getppid(), set()
        self.stopped = False
        signal.signal(signal.SIGTERM, self._stop)
        signal.signal(signal.SIGINT, self._stop)
        self.announce("Starting", force=True)

    def _stop(self, *_):
        self.stopped = True

    def announce(self, state, force=False):
        """Says how we are."""
        if force or int(self._beat[0]["state"]) != STATES[state]:
            self._beat[0]["state"] = STATES[state]
            self._send()

    def refuse(self):
        """Says that we do not fit to the others, and go."""
        self._beat[0]["fault_code"] = _FAULT_REFUSED
        self.announce("Fault")

    def _send(self):
        beat = self._beat[0]
        beat["header"]["sequence"] += 1
        beat["time_ns"] = beat["header"]["sent_at_ns"] = time.monotonic_ns()
        self._out.send(self._beat)

    def say_once(self, text):
        """A line on standard error, the first time only."""
        if text not in self._told:
            self._told.add(text)
            os.write(2, f"{text}\n".encode())

    def attend(self):
        """`wait`, `run`, or why to end: `stop`, `supervisor lost`, `peer lost`."""
        now = time.monotonic_ns()
        if now >= int(self._beat[0]["time_ns"]) + WIRE["heartbeat_period_ns"]:
            self._send()
        for name, ear in self._ears.items():
            beat = ear.latest()
            if beat is None:
                continue
            if name == self.other and int(beat["header"]["joint_set_hash"]) != self.connection.joint_set_hash:
                self.say_once(f"the {name} of this run has other joints (hash {int(beat['header']['joint_set_hash']):016x}, ours is "
                              f"{self.connection.joint_set_hash:016x}): it is refused")
                continue
            if int(beat["state"]) == STATES["Fault"] and int(beat["fault_code"]) == _FAULT_REFUSED:
                self.say_once(f"a {name} process could not connect: its messages are of another version, or its services have other settings")
                self.heard[name] = None
                continue
            self.heard[name] = beat
        if self.stopped:
            return "stop"
        if self.supervised:
            if os.getppid() != self._parent:
                return "supervisor lost"
            state = self.state_of("supervisor")
            return {"Stopping": "stop", "Running": "run"}.get(state, "wait")
        if self.state_of(self.other) not in (None, "Finished", "Fault") and not _lives(int(self.heard[self.other]["pid"])):
            return "peer lost"
        return "run"

    def state_of(self, role):
        """The state another process announced last, or None."""
        beat = self.heard[role]
        names = {code: name for name, code in STATES.items()}
        return None if beat is None else names.get(int(beat["state"]))

    def peer_is_done(self):
        """Whether the other process has said that it is done."""
        return self.state_of(self.other) in ("Finished", "Fault")


def _lives(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
