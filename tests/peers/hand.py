"""The robot hand: our description, one forward kinematics for all methods, and the URDF that the peers expect."""

import tomllib
import xml.etree.ElementTree as xml
from pathlib import Path

import numpy as np
import pinocchio

FINGERS = ("thumb", "index", "middle", "ring")
# Where dex-urdf puts the wrist, which the peers measure fingertips from, in palm_link (m).
WRIST = np.array([0.0, 0.0, -0.095])


class Hand:
    """Joint angles are of shape (16,), rad, in the order of the description; positions are in palm_link, m."""

    def __init__(self, folder: Path, side: str):
        self.side = side
        self.urdf = folder / f"allegro_v4_{side}.urdf"
        description = tomllib.loads((folder / f"allegro_v4_{side}.toml").read_text())
        self.joints = description["joints"]["order"]
        finger = {finger["name"]: finger for finger in description["finger"]}
        self.model = pinocchio.buildModelFromUrdf(str(self.urdf))
        self.data = self.model.createData()
        self.index = joint_indices(self.model, self.joints)
        self.poles = [self.model.getFrameId(finger[name]["pole"]) for name in FINGERS]
        self.centers = [self.model.getFrameId(finger[name]["center"]) for name in FINGERS]
        self.lower = self.model.lowerPositionLimit[self.index]
        self.upper = self.model.upperPositionLimit[self.index]

    def tips(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poles and centres of the fingertips, each (frames, 4, 3), for q (frames, 16)."""
        poles, centers = np.empty((len(q), 4, 3)), np.empty((len(q), 4, 3))
        for i, angles in enumerate(q):
            ordered = np.empty(self.model.nq)
            ordered[self.index] = angles
            pinocchio.framesForwardKinematics(self.model, self.data, ordered)
            poles[i] = [self.data.oMf[frame].translation for frame in self.poles]
            centers[i] = [self.data.oMf[frame].translation for frame in self.centers]
        return poles, centers

    def peer_name(self, name: str) -> str:
        """The name that dex-urdf gives to one of our joints or links: its tips are our poles, and its left hand counts
        the fingers from the other side."""
        kind, _, rest = name.partition("_")
        number, dot, rest = rest.partition(".")
        if self.side == "left" and dot and (int(number) < 4 or 8 <= int(number) < 12):
            number = str((int(number) + 8) % 16)
        return f"{kind}_{number}{dot}{rest}".replace("_tip", "_center").replace("_pole", "_tip")

    def write_peer_urdf(self, path: Path) -> None:
        """Our hand under dex-urdf's names and with its wrist, without shapes."""
        robot = xml.parse(self.urdf).getroot()
        for link in robot.findall("link"):
            for shape in link.findall("visual") + link.findall("collision"):
                link.remove(shape)
        for element in [*robot.findall("link"), *robot.findall("joint"), *robot.findall("joint/*[@link]")]:
            key = "link" if "link" in element.attrib else "name"
            element.set(key, self.peer_name(element.get(key)))
        xml.SubElement(robot, "link", name="wrist")
        joint = xml.SubElement(robot, "joint", name="wrist_joint", type="fixed")
        xml.SubElement(joint, "parent", link=robot.find("link").get("name"))
        xml.SubElement(joint, "child", link="wrist")
        xml.SubElement(joint, "origin", xyz=" ".join(map(str, WRIST)))
        xml.ElementTree(robot).write(path)

    def check_peer_urdf(self, ours: Path, theirs: Path) -> float:
        """Largest difference (m) of fingertips from the wrist, and of limits (rad), between two URDFs with dex-urdf's
        names. The left thumb is left out: dex-urdf forgot to mirror the origin of its joint_13."""
        models = [pinocchio.buildModelFromUrdf(str(path)) for path in (ours, theirs)]
        names = [self.peer_name(name) for name in self.joints]
        indices = [joint_indices(model, names) for model in models]
        tips = [self.peer_name(self.model.frames[frame].name) for frame in self.poles]
        random = np.random.default_rng(1)
        worst = 0.0
        for _ in range(100):
            q = random.uniform(self.lower, self.upper)
            found = []
            for model, index in zip(models, indices):
                data, ordered = model.createData(), np.empty(model.nq)
                ordered[index] = q
                pinocchio.framesForwardKinematics(model, data, ordered)
                wrist = data.oMf[model.getFrameId("wrist")]
                points = [wrist.actInv(data.oMf[model.getFrameId(tip)]).translation for tip in tips]
                found.append(np.array(points[1:] if self.side == "left" else points))
            worst = max(worst, np.abs(found[0] - found[1]).max())
        for limits in ("lowerPositionLimit", "upperPositionLimit"):
            a, b = (getattr(model, limits)[index] for model, index in zip(models, indices))
            worst = max(worst, np.abs(a - b).max())
        return worst


def joint_indices(model: pinocchio.Model, names: list[str]) -> np.ndarray:
    """Where the named joints are in the model's vector, which is sorted by name."""
    return np.array([model.joints[model.getJointId(name)].idx_q for name in names])
