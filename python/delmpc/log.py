"""The log of a run as numpy arrays; as pandas tables where that is wanted."""
import os
import re
import struct

import numpy as np

from .wire import COMMAND, MAX_JOINTS, PLANT_STATE, TYPES

_ROS = {"uint32": "<u4", "uint64": "<u8", "float64": "<f8", "int32": "<i4", "int64": "<i8"}
_HEAD = COMMAND.fields["segments"][1]
_LISTS = ("torque", "torque_lower", "torque_upper", "position_ref", "velocity_ref", "acceleration_ref")
_IMU = ("imu_angle_ref", "imu_rate_ref", "imu_acceleration_ref")


class Run:
    """What a run left: `states`, `truth`, `commands` are structured arrays; `joints` their order; `about` and `summary` what was said."""

    def __init__(self, states, truth, commands, joints, about, summary):
        self.states, self.truth, self.commands = states, truth, commands
        self.joints, self.about, self.summary = joints, about, summary

    @property
    def contacts(self):
        """Time (s), which feet touch, where they are (m), steps x feet."""
        truth, feet = self.truth, int(self.truth["n_feet"].max(initial=0))
        touching = (truth["feet_touching"][:, None] >> np.arange(feet)) & 1
        return {"time_s": truth["time_ns"] * 1e-9, "touching": touching.astype(bool), "position_w": truth["foot_position_w"][:, :feet]}

    @property
    def plan(self):
        """What every command planned: time (s) of the begin of each segment, its joint positions, velocities and torques; commands x
        segments x joints, NaN behind the segments in use."""
        c, n = self.commands, len(self.joints)
        segments = c["segments"]
        unused = np.arange(segments.shape[1])[None, :] >= c["n_segments"][:, None]
        time_s = (c["valid_from_ns"][:, None] + segments["begin_ns"]) * 1e-9
        plan = {"time_s": np.where(unused, np.nan, time_s)}
        for key, field in (("position", "position_ref"), ("velocity", "velocity_ref"), ("torque", "torque")):
            plan[key] = np.where(unused[:, :, None], np.nan, segments[field][:, :, :n])
        return plan

    def table(self, name="truth"):
        """`truth`, `states` or `commands` as a pandas table: index time in s, a column for every number, joints by their names."""
        import pandas
        rows = getattr(self, name)
        time_ns = rows["state_time_ns" if name == "commands" else "time_ns"]
        columns = {}
        for field in rows.dtype.names:
            if rows[field].dtype.names or field in ("gain", "imu_gain"):
                continue
            values = rows[field]
            if values.ndim == 1:
                columns[field] = values
            elif values.ndim == 2 and values.shape[1] == MAX_JOINTS:
                columns |= {f"{field}.{joint}": values[:, i] for i, joint in enumerate(self.joints)}
            else:
                flat = values.reshape(len(values), -1)
                columns |= {f"{field}[{i}]": flat[:, i] for i in range(flat.shape[1])}
        return pandas.DataFrame(columns, index=pandas.Index(time_ns * 1e-9, name="time_s"))


def read(folder):
    """Reads the folder of a run, or its log.mcap. Needs the package `mcap`: pip install 'delmpc[log]'.

    A log that is cut, since its writer was killed, is read up to there.
    """
    import json
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader
    log = os.path.join(folder, "log.mcap") if os.path.isdir(folder) else folder
    records = {"/plant/state": [], "/plant/truth": [], "/controller/command": []}
    truth_type = None
    with open(log, "rb") as file:
        reader = NonSeekingReader(file)
        try:
            for schema, channel, message in reader.iter_messages(topics=list(records), log_time_order=False):
                if channel.topic == "/plant/truth" and truth_type is None:
                    truth_type = dtype_of(schema.data.decode())
                records[channel.topic].append(message.data[4:])
        except (McapError, struct.error, EOFError):
            pass
    about = _about(log)
    states = _join(records["/plant/state"], PLANT_STATE)
    truth = _join(records["/plant/truth"], truth_type or np.dtype([("time_ns", "<u8"), ("n_feet", "<u4"), ("feet_touching", "<u4")]))
    commands = np.zeros(len(records["/controller/command"]), COMMAND)
    for index, data in enumerate(records["/controller/command"]):
        _unpack(data, commands, index)
    summary = os.path.join(os.path.dirname(log), "summary.json")
    known = None
    if os.path.isfile(summary):
        with open(summary, encoding="utf-8") as file:
            known = json.load(file)
    return Run(states, truth, commands, about.get("joints", "").split(), about, known)


def _about(log):
    from mcap.exceptions import McapError
    from mcap.records import Metadata
    from mcap.stream_reader import StreamReader
    with open(log, "rb") as file:
        try:
            for record in StreamReader(file).records:
                if isinstance(record, Metadata) and record.name == "run":
                    return dict(record.metadata)
        except (McapError, struct.error, EOFError):
            pass
    return {}


def _join(parts, dtype):
    whole = [part for part in parts if len(part) == dtype.itemsize]
    return np.frombuffer(b"".join(whole), dtype)


def dtype_of(schema):
    """A numpy type from a ROS 2 message definition whose fields have fixed lengths."""
    blocks = re.split(r"^=+\s*$", schema, flags=re.M)
    parts = {}
    for block in blocks[1:]:
        head, _, body = block.strip().partition("\n")
        parts[head.removeprefix("MSG:").strip()] = body
    return _fields(blocks[0], parts)[0]


def _fields(text, parts):
    names, formats, offsets, offset, widest = [], [], [], 0, 1
    for line in text.strip().splitlines():
        if not line or line.startswith("#"):
            continue
        kind, name = line.split()[:2]
        kind, _, length = kind.partition("[")
        shape = (int(length.rstrip("]")),) if length else ()
        inner, alignment = (np.dtype(_ROS[kind]), int(_ROS[kind][-1])) if kind in _ROS else _fields(parts[kind], parts)
        offset = -(-offset // alignment) * alignment
        names.append(name)
        formats.append((inner, shape))
        offsets.append(offset)
        offset += inner.itemsize * int(np.prod(shape, dtype=int))
        widest = max(widest, alignment)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": offset}), widest


def _unpack(data, commands, index):
    """A command of the log, which holds what is in use, into a message of an array."""
    commands[index:index + 1].view(np.uint8)[:_HEAD] = np.frombuffer(data[:_HEAD], np.uint8)
    command = commands[index]
    at, n = _HEAD, int(command["n_joints"])

    def length():
        nonlocal at
        value = struct.unpack_from("<I", data, at)[0]
        at = -(-(at + 4) // 8) * 8
        return value

    def numbers(count):
        nonlocal at
        values = np.frombuffer(data, "<f8", count, at)
        at += 8 * count
        return values

    for k in range(length()):
        segment = command["segments"][k]
        segment["begin_ns"] = struct.unpack_from("<Q", data, at)[0]
        at += 8
        for name in _LISTS:
            segment[name][:n] = numbers(length())
        for name in _IMU:
            segment[name] = numbers(3)
    gain = numbers(length()).reshape(n, 2 * n)
    command["gain"][:n, :n], command["gain"][:n, MAX_JOINTS:MAX_JOINTS + n] = gain[:, :n], gain[:, n:]
    command["imu_gain"][:n] = numbers(length()).reshape(n, 6)
    command["imu_rate_bias"] = numbers(3)
    feet = command.dtype["load_foot"].shape[0]
    command["load_foot"] = np.frombuffer(data, "<u4", feet, at)
    at += 4 * feet
    command["full_load_n"] = numbers(len(command["full_load_n"]))
    for name in ("unloaded_stiffness", "unloaded_damping"):
        command[name][:n] = numbers(length())
    for name in ("report", "estimate"):
        size = TYPES["CycleReport" if name == "report" else "StateEstimate"].itemsize
        command[name] = np.frombuffer(data[at:at + size], TYPES["CycleReport" if name == "report" else "StateEstimate"])[0]
        at += size
