"""A robot of delmpc (URDF and companion table) as a model of MuJoCo."""
import tomllib
import xml.etree.ElementTree as ET

import mujoco
import numpy as np


def rpy(roll, pitch, yaw):
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    return np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                     [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], [-sp, cp * sr, cp * cr]])


def quat_wxyz(rotation):
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(rotation, float).ravel())
    return quat


def matrix(xyzw):
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.array([xyzw[3], *xyzw[:3]], float))
    return out.reshape(3, 3)


def _vector(element, key, default="0 0 0"):
    return [float(x) for x in (element.get(key, default) if element is not None else default).split()]


class Robot:
    """Links, joints, contact points and soles from the files a connection names."""

    def __init__(self, connection):
        root = ET.parse(connection["urdf"]).getroot()
        with open(connection["companion"], "rb") as file:
            companion = tomllib.load(file)
        self.links, self.joints = {}, []
        for link in root.findall("link"):
            inertial = link.find("inertial")
            if inertial is None:
                raise SystemExit(f"link {link.get('name')} has no inertia: this example does not merge links")
            origin, tensor = inertial.find("origin"), inertial.find("inertia")
            ixx, iyy, izz, ixy, ixz, iyz = (float(tensor.get(k)) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
            turn = rpy(*_vector(origin, "rpy"))
            full = turn @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ turn.T
            self.links[link.get("name")] = (float(inertial.find("mass").get("value")), _vector(origin, "xyz"), full)
        for joint in root.findall("joint"):
            if joint.get("type") not in ("revolute", "continuous"):
                raise SystemExit(f"joint {joint.get('name')} is {joint.get('type')}: this example knows joints that turn")
            origin, dynamics = joint.find("origin"), joint.find("dynamics")
            self.joints.append({
                "name": joint.get("name"), "parent": joint.find("parent").get("link"), "child": joint.find("child").get("link"),
                "xyz": _vector(origin, "xyz"), "rot": rpy(*_vector(origin, "rpy")), "axis": _vector(joint.find("axis"), "xyz", "1 0 0"),
                "damping": float(dynamics.get("damping", 0)) if dynamics is not None else 0.0})
        children = {joint["child"] for joint in self.joints}
        self.root = next(name for name in self.links if name not in children)
        self.contacts, self.frames, self.soles = companion["contact"], companion["frame"], companion["sole"]
        self.frame = {frame["name"]: frame for frame in self.frames}

    def mjcf(self, connection, options):
        """The model: ground with its slope and boxes, the robot with spheres at its contact points."""
        fmt = lambda values: " ".join(repr(float(x)) for x in values)  # noqa: E731
        plant, ground = connection["plant"], connection["ground"]
        surface = f'condim="3" friction="{ground["friction"]} 0 0" solref="{options.solref}" solimp="{options.solimp}"'
        of = {}
        for joint in self.joints:
            of.setdefault(joint["parent"], []).append(joint)

        def body(name, pose, joint):
            mass, com, inertia = self.links[name]
            mass, inertia = plant["mass_scale"] * mass, plant["mass_scale"] * plant["inertia_scale"] * inertia
            com = np.array(com) + plant["com_shift_m"]
            six = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
            out = [f'<body name="{name}" {pose}>', f'<inertial pos="{fmt(com)}" mass="{mass}" fullinertia="{fmt(six)}"/>', joint]
            for point in self.contacts:
                if point["link"] == name:
                    radius = point.get("radius_m", 0.0)
                    # A point becomes a sphere of 1 mm whose lowest point it is.
                    at = np.array(point["position_m"]) + (0.0 if radius else np.array([0, 0, 1e-3]))
                    out.append(f'<geom name="{point["name"]}" type="sphere" size="{radius or 1e-3}" pos="{fmt(at)}" contype="1" '
                               f'conaffinity="0" {surface} mass="0"/>')
            for frame in self.frames:
                if frame["link"] == name:
                    turn = fmt(quat_wxyz(rpy(*frame.get("rpy_rad", [0, 0, 0]))))
                    out.append(f'<site name="{frame["name"]}" pos="{fmt(frame["position_m"])}" quat="{turn}"/>')
            for child in of.get(name, []):
                place = f'pos="{fmt(child["xyz"])}" quat="{fmt(quat_wxyz(child["rot"]))}"'
                hinge = f'<joint name="{child["name"]}" type="hinge" axis="{fmt(child["axis"])}" damping="{child["damping"]}" limited="false"/>'
                out.append(body(child["child"], place, hinge))
            return "\n".join([*out, "</body>"])

        boxes = "".join(f'<geom type="box" size="{fmt(b["half_size_m"])}" pos="{fmt(b["center_m"])}" euler="0 0 {b["yaw_rad"]}" contype="0" '
                        f'conaffinity="1" {surface}/>' for b in ground["boxes"])
        slope = fmt(quat_wxyz(matrix(ground["orientation_w"])))
        return f'''<mujoco><compiler angle="radian" autolimits="false" balanceinertia="false" inertiafromgeom="false"/>
<option timestep="{options.dt}" integrator="implicitfast" cone="elliptic" impratio="{options.impratio}" solver="Newton" tolerance="1e-10"
 iterations="50" ls_iterations="50" gravity="0 0 -9.81"/>
<worldbody><body name="ground" quat="{slope}"><geom type="plane" size="20 20 1" contype="0" conaffinity="1" {surface}/>{boxes}</body>
{body(self.root, "", '<freejoint name="root"/>')}</worldbody></mujoco>'''
