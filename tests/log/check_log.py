"""Opens the log of a lockstep run with the `mcap` package and checks everything a stranger relies on.

Usage: check_log.py RUN_FOLDER
Needs: pip install mcap
"""

import json
import struct
import sys
import tomllib
from pathlib import Path

from mcap.reader import make_reader

WIDTH = {"uint32": ("I", 4), "uint64": ("Q", 8), "float64": ("d", 8)}


def read_fields(lines, types, data, offset):
    """Decodes a ros2msg message that lies in memory as it is; returns fields and end."""
    fields = {}
    for line in lines:
        kind, name = line.split()
        count = 1
        if kind.endswith("]"):
            kind, count = kind[:-1].split("[")
            if count.startswith("<="):
                offset += -offset % 4
                (found,) = struct.unpack_from("<I", data, offset)
                assert found <= int(count[2:]), (line, found)
                offset += 4
                count = found
            else:
                count = int(count)
            many = True
        else:
            many = False
        if kind in types:
            parts = []
            for _ in range(count):
                offset += -offset % 8
                part, offset = read_fields(types[kind], types, data, offset)
                parts.append(part)
            fields[name] = parts if many else parts[0]
            continue
        letter, width = WIDTH[kind]
        offset += -offset % width
        values = struct.unpack_from(f"<{count}{letter}", data, offset)
        fields[name] = values if many else values[0]
        offset += count * width
    return fields, offset


def decode(schema, data):
    """By nothing but the schema in the file."""
    first, *others = schema.data.decode().split("=" * 80 + "\n")
    types = {}
    for other in others:
        head, *lines = other.strip().split("\n")
        types[head.removeprefix("MSG: ")] = lines
    body = data[4:]  # behind the encapsulation header
    fields, end = read_fields(first.strip().split("\n"), types, body, 0)
    assert end == len(body), f"{schema.name}: the schema describes {end} bytes of {len(body)}"
    return fields


class Cdr:
    """Reads ROS 2's encoding: alignment from behind the header of four bytes."""

    def __init__(self, data):
        self.data, self.at = data[4:], 0

    def take(self, letter, size, count=1):
        self.at += -self.at % size
        values = struct.unpack_from(f"<{count}{letter}", self.data, self.at)
        self.at += size * count
        return values

    def text(self):
        (length,) = self.take("I", 4)
        text = self.data[self.at : self.at + length]
        self.at += length
        assert text.endswith(b"\0"), text
        return text[:-1].decode()


def transforms(data):
    """Child and parent of every transform of a TFMessage; each a turn and a finite place."""
    cdr, frames = Cdr(data), {}
    for _ in range(cdr.take("I", 4)[0]):
        cdr.take("I", 4, 2)
        parent, child = cdr.text(), cdr.text()
        *place, x, y, z, w = cdr.take("d", 8, 7)
        assert abs(x * x + y * y + z * z + w * w - 1) < 1e-9 and all(abs(p) < 1e3 for p in place), (child, place)
        frames[child] = parent
    assert cdr.at == len(cdr.data)
    return frames


def joint_names(data):
    """Names of a JointState, which has three numbers for each."""
    cdr = Cdr(data)
    cdr.take("I", 4, 2)
    assert cdr.text() == ""
    names = [cdr.text() for _ in range(cdr.take("I", 4)[0])]
    for _ in range(3):
        (count,) = cdr.take("I", 4)
        assert count == len(names)
        cdr.take("d", 8, count)
    assert cdr.at == len(cdr.data)
    return names


def matches(schema, value, where):
    """Whether a JSON value is what its JSON schema says (type, properties, items)."""
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
    assert isinstance(value, kinds[schema["type"]]), f"{where}: {value!r} is no {schema['type']}"
    for name, sub in schema.get("properties", {}).items():
        assert name in value, f"{where}.{name} is missing"
        matches(sub, value[name], f"{where}.{name}")
    for index, item in enumerate(value if "items" in schema else []):
        matches(schema["items"], item, f"{where}[{index}]")


def main(folder):
    summary = json.loads((folder / "summary.json").read_text())
    with open(folder / "log.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        statistics = reader.get_summary()
        counts = {
            statistics.channels[key].topic: count for key, count in statistics.statistics.channel_message_counts.items()
        }
        seen = dict.fromkeys(counts, 0)
        last_truth, moments = None, []
        for schema, channel, message in reader.iter_messages():
            seen[channel.topic] += 1
            if schema.encoding == "jsonschema":
                matches(json.loads(schema.data), json.loads(message.data), channel.topic)
            elif channel.topic == "/tf":
                assert (schema.name, schema.encoding, channel.message_encoding) == ("tf2_msgs/msg/TFMessage", "ros2msg", "cdr")
                moments.append(message.log_time)
                frames = transforms(message.data)
            elif channel.topic == "/joint_states":
                assert schema.name == "sensor_msgs/msg/JointState", schema.name
                joints = joint_names(message.data)
            elif channel.topic == "/plant/truth":
                last_truth = decode(schema, message.data)
                assert last_truth["time_ns"] == message.log_time
            elif channel.topic == "/controller/command" and seen[channel.topic] == 1:
                command = decode(schema, message.data)
                assert command["header"]["magic"] and command["n_joints"] == 30
                assert len(command["segments"]) == command["n_segments"] and len(command["gain"]) == 2 * 30 * 30
                begins = [segment["begin_ns"] for segment in command["segments"]]
                assert begins[0] == 0 and begins == sorted(set(begins)), begins
        (about,) = (record.metadata for record in reader.iter_metadata() if record.name == "run")
        files = {attachment.name: attachment.data for attachment in reader.iter_attachments()}

    assert seen == counts, f"the index says {counts}, read were {seen}"
    assert counts["/plant/truth"] == summary["steps"] + 1, counts
    assert counts["/controller/command"] == summary["cycles"], counts
    # One state for each cycle, and the last one, which says that the run is over.
    assert counts["/plant/state"] == summary["cycles"] + 1, counts
    assert counts["/robot"] == 1 and counts["/tf"] == counts["/forces"] == counts["/joint_states"], counts
    assert joints == about["joints"].split(), joints
    rate = 30 * summary["duration_s"]
    assert abs(counts["/tf"] - rate) <= 2 + 0.02 * rate, (counts, rate)
    assert abs(last_truth["time_ns"] * 1e-9 - summary["duration_s"]) < 1e-6
    assert moments == sorted(moments)
    # Every frame hangs on the world.
    for frame in frames:
        while frame != "world":
            frame = frames[frame]
    for key in ["program", "scenario", "seed", "configuration", "model_hash", "joint_set_hash", "git_revision"]:
        assert about[key], key
    assert tomllib.loads(about["configuration"])["seed"] == summary["seed"] == int(about["seed"])
    for name in ["scenario.toml", "robot.urdf", "robot.toml"]:
        assert files[name] == (folder / name).read_bytes(), name
    print(json.dumps(counts))


main(Path(sys.argv[1]))
