"""Data sets by name: the list, the options, UCI folders and the movements of the thesis."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

import zoo
from zoo.datasets.store import FileFormatError, MissingDataError
from zoo.errors import UnknownNameError

DATA = os.environ.get("MOVEZOO_DATA", "")


def needs(relative: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(
        not Path(DATA, relative).exists(), reason=f"MOVEZOO_DATA names no folder with {relative}"
    )


SIMULATED = [n for n in zoo.list_data() if n.startswith(("robot-arm", "pendulum"))]


@pytest.mark.parametrize("name", SIMULATED)
def test_simulated_data_bear_their_name(name: str) -> None:
    data = zoo.load_data(name)
    assert data.name == name and data.provenance == "simulated"
    with pytest.raises(UnknownNameError, match=f"{name} takes no option 'folder'"):
        zoo.load_data(name, folder="somewhere")


@needs("cmu-mocap/35/35.asf")
@needs("thesis-movements")
@needs("uci")
@pytest.mark.parametrize("name", sorted(set(zoo.list_data()) - set(SIMULATED)))
def test_real_data_bear_their_name(name: str) -> None:
    data = zoo.load_data(name)
    assert data.name == name and data.provenance in ("public", "thesis")
    assert data.layout.channels and len(data.groups) > 0


def test_unknown_names_are_told_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="no data set 'robot-amr'; did you mean robot-arm"):
        zoo.load_data("robot-amr")
    with pytest.raises(UnknownNameError, match="no data set 'cmu-mocap'"):
        zoo.load_data("cmu-mocap")


@needs("thesis-movements")
def test_movements_of_the_thesis() -> None:
    data = zoo.load_data("thesis-movements")
    assert data.values.shape == (5, 70, 50) and bool(data.mask.all())
    assert data.groups["movement"] == ("walking", "balance", "kicking", "tai_chi", "punching")
    assert data.groups["subject"] == ("35", "49", "74", "120", "143")
    # Folded angles, but for one frame of rfemur_rx in balance.
    assert int((data.values.abs() > np.pi / 2).sum()) == 1
    assert data.units == ("rad",) * 50 and data.layout.rate is None


@needs("thesis-movements")
def test_punching_is_one_arm_along_a_line_and_tai_chi_moves_all_limbs() -> None:
    data = zoo.load_data("thesis-movements")
    limbs = "lhumerus", "rhumerus", ("lfemur", "ltibia"), ("rfemur", "rtibia")
    for name, line, everywhere in (("punching", True, False), ("tai_chi", False, True)):
        x = data.where(movement=name).values[0].double().numpy()
        variance = np.linalg.svd(x - x.mean(0), compute_uv=False) ** 2
        moved = [x[:, [c.startswith(limb) for c in data.channels]].var(0).sum() for limb in limbs]
        assert (variance[0] > 0.7 * variance.sum()) == line
        assert (min(moved) > 0.1 * x.var(0).sum()) == everywhere


@needs("thesis-movements")
def test_plain_dmp_errs_most_where_table_2_says_so() -> None:
    data = zoo.load_data("thesis-movements")
    error = {}
    for name in ("kicking", "tai_chi", "punching"):
        movement = data.where(movement=name)
        run = zoo.fit(zoo.create("dmp", movement), movement)
        residual = run.reconstruct(movement, draws=1).mean - movement.values
        error[name] = float(residual.square().mean())
    assert error["punching"] < 1e-4 < 1e-3 < min(error["kicking"], error["tai_chi"])


@needs("thesis-movements")
def test_a_file_with_two_names_exchanged_is_refused(tmp_path: Path) -> None:
    with np.load(Path(DATA, "thesis-movements", "movements.npz")) as archive:
        arrays = dict(archive)
    arrays["punching"], arrays["tai_chi"] = arrays["tai_chi"], arrays["punching"]
    np.savez(tmp_path / "movements.npz", **arrays)
    with pytest.raises(FileFormatError, match="the two arrays have each other's names"):
        zoo.load_data("thesis-movements", folder=tmp_path)


def test_movements_of_the_thesis_that_are_not_as_they_should_be(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"movements\.npz is not in the folder"):
        zoo.load_data("thesis-movements", folder=tmp_path)
    np.savez(tmp_path / "movements.npz", columns=np.array(["a"]), walking=np.zeros((70, 50)))
    with pytest.raises(FileFormatError, match="no array 'balance'; it holds columns, walking"):
        zoo.load_data("thesis-movements", folder=tmp_path)


@needs("uci")
@pytest.mark.parametrize("name", ["concrete", "energy", "yacht"])
def test_published_splits_are_partitions(name: str) -> None:
    whole = zoo.load_data(f"uci/{name}")
    for split in range(10):
        train, test = zoo.load_data(f"uci/{name}", split=split)
        items = sorted(int(i) for part in (train, test) for i in part.groups["item"])
        assert items == list(range(len(whole)))
        assert len(test) == round(0.1 * len(whole))
    assert not any(feature.startswith("feature_") for feature in whole.features)


FILES = {
    "data.txt": "1 2 3\n4 5 6\n7 8 9\n",
    "index_features.txt": "0\n1\n",
    "index_target.txt": "2\n",
    "index_train_0.txt": "0\n2\n",
    "index_test_0.txt": "1\n",
}


def uci(folder: Path, **changed: str) -> Path:
    """A small folder in the published form, with some files changed."""
    for name, text in FILES.items():
        (folder / name).write_text(changed.get(name.partition(".")[0], text))
    return folder


def test_any_folder_of_the_form_is_a_data_set(tmp_path: Path) -> None:
    train, test = zoo.load_data("uci/own", folder=uci(tmp_path), split=0)
    assert train.inputs.tolist() == [[1, 2], [7, 8]] and test.targets.tolist() == [[6]]
    assert train.name == "uci/own" and test.groups["item"] == ("1",)


BROKEN = {
    "ragged": ({"data": "1 2 3\n4 5\n"}, "data.txt, line 2: 2 values; the first line has 3"),
    "word": ({"data": "1 2 3\n4 x 6\n"}, "data.txt, line 2: 'x' is not a number"),
    "empty": ({"data": "\n"}, "data.txt: the file is empty"),
    "column": ({"index_features": "0\n7\n"}, "line 2: 7 is none of the 3 columns"),
    "fraction": ({"index_features": "0.5\n"}, "one whole number a line is needed"),
    "leak": ({"index_test_0": "2\n"}, "1 items are in the training part as well (first: 2)"),
    "twice": ({"index_train_0": "0\n0\n"}, "items are named more than once"),
    "target": ({"index_target": "1\n"}, "columns {1} are features as well"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_folders_are_named(tmp_path: Path, case: str) -> None:
    changed, reason = BROKEN[case]
    with pytest.raises(FileFormatError, match=re.escape(reason)):
        zoo.load_data("uci/own", folder=uci(tmp_path, **changed), split=0)


def test_absent_splits_and_folders_say_how_to_get_them(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"index_train_11\.txt is not in the folder"):
        zoo.load_data("uci/own", folder=uci(tmp_path), split=11)
    with pytest.raises(MissingDataError, match=r"put its text files into \$MOVEZOO_DATA/uci/boats"):
        zoo.load_data("uci/boats", folder=tmp_path / "none")


def test_a_misspelt_member_of_a_family_is_recognised(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"concret/data.txt is not in .* mean concrete\?"):
        zoo.load_data("uci/concret", folder=tmp_path)
