"""The ASF/AMC reader: good files in every dress, broken ones named, kinematics by other roads."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from acclaim_files import AMC, ASF, write
from scipy.spatial.transform import Rotation

from zoo.datasets.amc import read_amc
from zoo.datasets.asf import read_asf
from zoo.datasets.skeleton import Bone, Skeleton
from zoo.datasets.store import FileFormatError

METRE = 0.0254 / 0.5


def leg(folder: Path) -> Skeleton:
    return read_asf(write(folder, "leg.asf", ASF))


def test_skeleton_of_a_file(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    assert skeleton.name == "leg" and skeleton.joints == ("root", "femur", "tibia", "heel")
    assert skeleton.parents == (-1, 0, 1, 2) and skeleton.edges == ((0, 1), (1, 2), (2, 3))
    assert skeleton.channels[6:] == ("femur_rx", "femur_ry", "femur_rz", "tibia_rx")
    assert skeleton.units == ("m",) * 3 + ("rad",) * 7
    assert skeleton.metre == pytest.approx(METRE)
    assert skeleton.bones[2].length == pytest.approx(3 * METRE)
    limits = torch.rad2deg(skeleton.limits[6:])
    expected = torch.tensor([[-160, 20], [-70, 70], [-math.inf, 70], [-10, 170]]).double()
    torch.testing.assert_close(limits, expected)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\r\r\n"])
def test_every_line_end_is_read(tmp_path: Path, end: str) -> None:
    skeleton = read_asf(write(tmp_path, "leg.asf", ASF, end))
    values = read_amc(write(tmp_path, "leg.amc", AMC, end), skeleton)
    assert values.shape == (3, 10)
    expected = [METRE, 2 * METRE, 3 * METRE, 0, 0, 0, *np.deg2rad([10, 20, 30])]
    for row, bend in zip(values.tolist(), (10, 20, 30), strict=True):
        assert row == pytest.approx([*expected, math.radians(bend)])


def test_comments_order_of_bones_and_radians(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    text = "# c\n:radians\n\n7 # first\ntibia 0.5\nfemur 1 2 3 # later\nroot 0 0 0 .1 .2 .3\n"
    values = read_amc(write(tmp_path, "r.amc", text), skeleton)
    assert values[0].tolist() == pytest.approx([0, 0, 0, 0.1, 0.2, 0.3, 1, 2, 3, 0.5])


BROKEN_AMC = {
    "unknown bone": (AMC.replace("femur 10", "femora 10", 1), 6, "unknown bone 'femora'"),
    "too few values": (AMC.replace("femur 10 20 30", "femur 10 20", 1), 6, "needs 3 values; got 2"),
    "too many values": (AMC.replace("tibia 10", "tibia 10 1"), 7, "needs 1 values; got 2"),
    "not a number": (AMC.replace("tibia 20", "tibia 2o"), 11, "'2o' is not a number"),
    "not finite": (AMC.replace("tibia 20", "tibia nan"), 11, "'nan' is not finite"),
    "infinite": (AMC.replace("tibia 20", "tibia inf"), 11, "'inf' is not finite"),
    "missing frame": (AMC.replace("\n2\n", "\n3\n", 1), 8, "frame 2 is missing; got frame 3"),
    "repeated frame": (AMC.replace("\n2\n", "\n1\n", 1), 8, "frame 2 is missing; got frame 1"),
    "bone twice": (AMC.replace("tibia 10\n", "tibia 10\ntibia 10\n"), 8, "comes twice in frame 1"),
    "bone lacking": (AMC.replace("tibia 10\n", ""), 7, "frame 1 lacks bone 'tibia'"),
    "truncated frame": (AMC[: AMC.rindex("femur")], 12, "frame 3 lacks bone 'femur' and 1 more"),
    "truncated line": (AMC[: AMC.rindex("20 30")], 14, "needs 3 values; got 1"),
    "no frame number": (AMC.replace("\n1\n", "\n", 1), 4, "'root' before the first frame number"),
    "unknown keyword": (AMC.replace(":DEGREES", ":GRADS"), 3, "unknown keyword ':GRADS'"),
    "late keyword": (AMC + ":RADIANS\n", 16, "after the first frame"),
    "empty": ("", None, "no frames"),
    "header alone": (":DEGREES\n", None, "no frames"),
    "something else": ("\x00\x01\x02 PNG", 1, "before the first frame number"),
}


@pytest.mark.parametrize("case", BROKEN_AMC)
def test_broken_amc_files_are_named_with_line_and_reason(tmp_path: Path, case: str) -> None:
    text, line, reason = BROKEN_AMC[case]
    path = write(tmp_path, "broken.amc", text)
    with pytest.raises(FileFormatError) as caught:
        read_amc(path, leg(tmp_path))
    assert isinstance(caught.value, ValueError)
    assert caught.value.file == str(path) and caught.value.line == line
    assert reason in caught.value.reason and str(path) in str(caught.value)


BROKEN_ASF = {
    "no hierarchy": (ASF[: ASF.index(":hierarchy")], None, "section :hierarchy is missing"),
    "no bones": (ASF.replace(":bonedata", ":bones"), None, "section :bonedata is missing"),
    "section twice": (ASF + ":units\n", 49, "section :units comes twice"),
    "no section": ("bone\n" + ASF, 1, "'bone' before the first :section"),
    "length unit": (ASF.replace("length 0.5\n  angle", "length 0\n  angle"), 6, "must be positive"),
    "angle unit": (ASF.replace("angle deg", "angle grad"), 7, "angle unit must be deg or rad"),
    "root order": (ASF.replace("order TX TY", "order TX TX"), 11, "order needs TX TY TZ RX RY RZ"),
    "root position": (ASF.replace("position 0 0 0", "position 0 0"), 13, "needs 3 numbers"),
    "no orientation": (ASF.replace("   orientation 0 0 0\n", ""), 10, ":root has no 'orientation'"),
    "no name": (ASF.replace("     name tibia\n", ""), 27, "bone has no 'name'"),
    "no direction": (ASF.replace("     direction 0 -1 0\n", ""), 16, "bone has no 'direction'"),
    "zero direction": (ASF.replace("direction 0 -1 0", "direction 0 0 0"), 19, "must not be zero"),
    "bad direction": (ASF.replace("direction 0 -1 0", "direction 0 x 0"), 19, "'x' is not"),
    "negative length": (ASF.replace("length 3", "length -3"), 31, "must not be negative; got -3"),
    "axis order": (ASF.replace("20 XYZ", "20 XYY"), 21, "axis order must be XYZ in some order"),
    "unknown dof": (ASF.replace("dof rx ry rz", "dof rx ry rw"), 22, "dof must be of rx, ry, rz"),
    "dof twice": (ASF.replace("dof rx ry rz", "dof rx ry ry"), 22, "once each"),
    "limits lacking": (ASF.replace("            (-inf 70.0)\n", ""), 23, "need 3 limits; got 2"),
    "half a limit": (ASF.replace("(-10.0 170.0)", "(-10.0)"), 34, "a limit needs two values"),
    "limits reversed": (ASF.replace("(-10.0 170.0)", "(10 -10)"), 34, "lower limit is above"),
    "bad limit": (ASF.replace("(-10.0 170.0)", "(-1o 170.0)"), 34, "'-1o' is not a number"),
    "bone twice": (ASF.replace("name tibia", "name femur"), 27, "bone 'femur' is defined twice"),
    "no parent": (ASF.replace("    tibia heel\n", ""), 43, "bone 'heel' has no parent"),
    "unknown child": (ASF.replace("tibia heel", "tibia toe"), 47, "unknown bone 'toe'"),
    "second parent": (ASF.replace("tibia heel", "tibia heel femur"), 47, "has a second parent"),
    "circle": (ASF.replace("    root femur\n", "").replace("tibia heel", "tibia heel femur"), None,
               "runs in a circle: femur, tibia, heel"),
    "truncated": (ASF[: ASF.index("     dof rx\n")], None, "section :hierarchy is missing"),
    "no end": (ASF[: ASF.rindex("  end")], 44, "'begin' without 'end': truncated?"),
    "nested begin": (ASF.replace("     id 2", "  begin"), 28, "inside the block of line 27"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN_ASF)
def test_broken_asf_files_are_named_with_line_and_reason(tmp_path: Path, case: str) -> None:
    text, line, reason = BROKEN_ASF[case]
    path = write(tmp_path, "broken.asf", text)
    with pytest.raises(FileFormatError) as caught:
        read_asf(path)
    assert reason in caught.value.reason and caught.value.line == line
    assert caught.value.file == str(path)


def test_one_bone_by_hand(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    # The tibia's axes are those of the world: it bends about x, in the plane of y and z.
    bend = torch.tensor([0.0, 0.3, math.pi / 2, -1.0], dtype=torch.float64)
    places = skeleton.positions(bend[:, None], channels=["tibia_rx"])
    shin = places[:, 2] - places[:, 1]
    x, y, z = 0.6 * 3 * METRE, -0.8 * 3 * METRE * bend.cos(), -0.8 * 3 * METRE * bend.sin()
    torch.testing.assert_close(shin, torch.stack([torch.full_like(y, x), y, z], -1))


def test_axes_of_the_joint_are_turned_as_the_file_says(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    turn = 0.7
    places = skeleton.positions(torch.tensor([turn], dtype=torch.float64), channels=["femur_rx"])
    axis = np.array([math.cos(math.radians(20)), math.sin(math.radians(20)), 0])
    expected = Rotation.from_rotvec(turn * axis).apply([0, -2 * METRE, 0])
    np.testing.assert_allclose(places[1], expected, atol=1e-15)


def by_scipy(skeleton: Skeleton, values: dict[str, float]) -> dict[str, np.ndarray]:
    """Joints by recursion from the leaves, with scipy's rotations about fixed axes."""
    bones = {b.name: b for b in skeleton.bones}

    def chain(bone: Bone) -> list[Bone]:
        return [bone] if bone.parent is None else [*chain(bones[bone.parent]), bone]

    def local(bone: Bone) -> Rotation:
        letters = "".join(d[1] for d in bone.dof if d[0] == "r")
        angles = [values[f"{bone.name}_r{a}"] for a in letters]
        about = [bone.axis["XYZ".index(a)] for a in bone.axis_order]
        axes = Rotation.from_euler(bone.axis_order.lower(), about)
        turn = Rotation.from_euler(letters, angles) if letters else Rotation.identity()
        return axes * turn * axes.inv()

    def place(bone: Bone) -> np.ndarray:
        at = np.array([values[f"root_{t}"] for t in ("tx", "ty", "tz")]) + skeleton.position
        turn = Rotation.identity()
        for link in chain(bone):
            turn = turn * local(link)
            at = at + turn.apply(np.array(link.direction) * link.length)
        return at

    return {name: place(bone) for name, bone in bones.items()}


def test_kinematics_equal_scipys_rotations(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    values = np.random.default_rng(0).normal(size=(6, 10))
    places = skeleton.positions(torch.from_numpy(values)).numpy()
    for row, place in zip(values, places, strict=True):
        expected = by_scipy(skeleton, dict(zip(skeleton.channels, row, strict=True)))
        np.testing.assert_allclose(place, [expected[j] for j in skeleton.joints], atol=1e-13)


def test_bones_keep_their_lengths_and_the_root_moves_all_alike(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    values = torch.from_numpy(np.random.default_rng(1).normal(size=(5, 4, 10)))
    places = skeleton.positions(values)
    assert places.shape == (5, 4, 4, 3)
    for parent, child in skeleton.edges:
        length = (places[..., child, :] - places[..., parent, :]).norm(dim=-1)
        torch.testing.assert_close(
            length, torch.full_like(length, skeleton.bones[child].length), rtol=1e-12, atol=0
        )
    moved, shift = values.clone(), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    moved[..., :3] += shift
    torch.testing.assert_close(skeleton.positions(moved), places + shift)
    still, turned = values.clone(), values.clone()
    still[..., :6] = 0
    turned[..., :3] = 0
    matrix = Rotation.from_euler("xyz", turned[..., 3:6].reshape(-1, 3).numpy()).as_matrix()
    rotate = torch.from_numpy(matrix).reshape(5, 4, 1, 3, 3)
    expected = (rotate @ skeleton.positions(still)[..., None])[..., 0]
    torch.testing.assert_close(skeleton.positions(turned), expected)


def test_kinematics_have_gradients_and_name_wrong_channels(tmp_path: Path) -> None:
    skeleton = leg(tmp_path)
    values = torch.zeros(1, 10, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(skeleton.positions, (values,))
    with pytest.raises(ValueError, match="values have 4 channels; 10 are needed"):
        skeleton.positions(torch.zeros(4))
    with pytest.raises(ValueError, match="no channel of the skeleton 'fibula_rx'"):
        skeleton.positions(torch.zeros(1), channels=["fibula_rx"])
