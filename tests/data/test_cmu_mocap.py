"""CMU motion capture: fifty channels, continuous angles, real trials, folders and downloads."""

import hashlib
import http.server
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from acclaim_files import AMC, ASF, write
from hypothesis import given, settings
from hypothesis import strategies as st

import zoo
from zoo.datasets import cmu_mocap
from zoo.datasets.amc import read_amc
from zoo.datasets.angles import continuous
from zoo.datasets.cmu_mocap import CONSTANT, load_skeleton
from zoo.datasets.records import Sequences
from zoo.datasets.store import FileFormatError, MissingDataError, download
from zoo.errors import UnknownNameError

DATA = os.environ.get("MOVEZOO_DATA", "")
real = pytest.mark.skipif(
    not Path(DATA, "cmu-mocap/35/35.asf").is_file(),
    reason="MOVEZOO_DATA names no folder with cmu-mocap/35",
)
JUMP = np.pi / 2


@pytest.fixture(scope="module")
def walks() -> Sequences:
    found: Sequences = zoo.load_data("cmu-mocap/35-walk", frames=None, angles="all")
    return found


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_turns_equal_angles_and_lost_signs_are_undone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = [f"{b}_{d}" for b, dofs in (("a", "xyz"), ("b", "xz"), ("c", "y")) for d in dofs]
    names = [n[:2] + "r" + n[2:] for n in names]
    smooth = np.cumsum(rng.uniform(-0.25, 0.25, (60, 6)), 0)
    smooth[:, 4] = 2.2 * np.sin(np.linspace(0, 6, 60))
    wrapped = smooth.copy()
    flipped = rng.random(60) < 0.2
    flipped[0] = False
    wrapped[flipped, :3] = smooth[flipped, :3] * (1, -1, 1) + np.pi
    wrapped[1:] += 2 * np.pi * rng.integers(-1, 2, (59, 6))
    lost = (np.abs(smooth[:, 4]) > 1.7) & (np.arange(60) > 0)
    wrapped[lost, 4] *= -1
    found, notes = continuous(wrapped, names)
    np.testing.assert_allclose(found, smooth, atol=1e-9)
    assert notes


def test_continuous_angles_and_translations_are_left_alone() -> None:
    values = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 4))
    values[10, 0] = 100.0
    found, notes = continuous(values, ["root_tx", "root_rx", "hand_rx", "hand_rz"])
    assert np.array_equal(found, values) and notes == ()


@real
def test_constant_channels_are_constant_in_every_trial_and_no_others(walks: Sequences) -> None:
    for array in walks.arrays:
        variance = array.var(0)
        still = {c for c, v in zip(walks.channels, variance, strict=True) if v < 1e-26}
        assert still == set(CONSTANT)


@real
def test_joint_angles_are_the_fifty_of_the_thesis() -> None:
    names = {n: zoo.load_data(n).channels for n in ("cmu-mocap/35_01", "cmu-mocap/35-run")}
    names["balance"] = zoo.load_data("cmu-mocap/49-balance").channels
    thesis = zoo.load_data("thesis-movements")
    assert len(thesis.channels) == 50
    assert all(channels == thesis.channels for channels in names.values())


@real
def test_balance_of_the_thesis_is_every_seventh_frame_of_49_18() -> None:
    thesis = zoo.load_data("thesis-movements").where(movement="balance")
    raw = zoo.load_data("cmu-mocap/49-balance", frames=None)
    frames = raw.values[0, 50 : 50 + 7 * 70 : 7].sin().asin()
    away = (frames - thesis.values[0]).abs().amax(0)
    differ = {c for c, d in zip(raw.channels, away.tolist(), strict=True) if d > 1e-7}
    # Three angles of the right leg differ by up to 0.032 rad between the two sources.
    assert differ == {"rfemur_rx", "rtibia_rx", "rfoot_rx"} and float(away.max()) < 0.033


@real
def test_walks_of_subject_35(walks: Sequences) -> None:
    assert len(walks) == 16 and walks.rate == 120 and walks.values.shape[2] == 62
    assert walks.groups["trial"][0] == "35_01" and set(walks.groups["subject"]) == {"35"}
    assert set(walks.groups["movement"]) == {"walk"}
    assert walks.units[:4] == ("m", "m", "m", "rad")
    equal = zoo.load_data("cmu-mocap/35-walk")
    assert equal.values.shape == (16, 70, 50) and bool(equal.mask.all())
    for raw, short in zip(walks.select(equal.channels).arrays, equal.arrays, strict=True):
        grid = np.linspace(0, len(raw) - 1, 70)
        plain = np.stack([np.interp(grid, np.arange(len(raw)), c) for c in raw.T], 1)
        assert np.sqrt(np.mean((plain - short) ** 2)) < np.deg2rad(1)
    by_rate = zoo.load_data("cmu-mocap/35_01", rate=30.0)
    assert by_rate.rate == 30 and by_rate.lengths.tolist() == [90]


@real
@pytest.mark.parametrize(("subject", "trials"), [("07", 9), ("08", 8), ("35", 16), ("49", 1)])
def test_a_subject_is_all_its_trials(subject: str, trials: int) -> None:
    data = zoo.load_data(f"cmu-mocap/{subject}", frames=None)
    files = Path(DATA, "cmu-mocap", subject).glob("*.amc")
    assert data.groups["trial"] == tuple(sorted(f.stem for f in files)) and len(data) == trials
    assert set(data.groups["subject"]) == {subject} and data.rate == 120
    assert "unknown" not in data.groups["movement"]
    one = zoo.load_data(f"cmu-mocap/{data.groups['trial'][0]}", frames=None)
    assert np.array_equal(one.arrays[0], data.arrays[0])


@real
def test_subjects_are_joined_and_split_by_subject() -> None:
    parts = [zoo.load_data(f"cmu-mocap/{s}", frames=None, rate=30.0) for s in ("07", "08", "35")]
    whole = zoo.concatenate(parts)
    assert len(whole) == 9 + 8 + 16 and len(whole.channels) == 50 and whole.rate == 30
    assert whole.where(subject="08").groups["trial"] == parts[1].groups["trial"]
    for array, same in zip(whole.where(subject="08").arrays, parts[1].arrays, strict=True):
        assert np.array_equal(array, same)
    split = whole.split(by="subject", parts=(1 / 3, 1 / 3, 1 / 3))
    assert sorted("".join(set(p.groups["subject"])) for p in split) == ["07", "08", "35"]
    equal = zoo.concatenate([zoo.load_data(f"cmu-mocap/{s}") for s in ("07", "49")])
    assert equal.values.shape == (10, 70, 50) and equal.layout.rate is None


def test_a_subject_without_files_is_named(tmp_path: Path) -> None:
    write(tmp_path, "90.asf", ASF)
    with pytest.raises(MissingDataError, match="no trial of subject 90 is in the folder"):
        zoo.load_data("cmu-mocap/90", folder=tmp_path)
    for number in (3, 1):
        write(tmp_path, f"90_{number:02d}.amc", AMC)
    data = zoo.load_data("cmu-mocap/90", folder=tmp_path, frames=None)
    assert data.groups["trial"] == ("90_01", "90_03")
    assert data.groups["movement"] == ("unknown", "unknown")


@real
def test_jumps_of_trial_14_and_19_are_undone_and_told() -> None:
    walk = zoo.load_data("cmu-mocap/35_14", frames=None)
    run = zoo.load_data("cmu-mocap/35-run", frames=None)
    for data in (walk, run):
        assert all(np.abs(np.diff(a, axis=0)).max() < JUMP for a in data.arrays)
    assert walk.notes == ("35_14: lthumb_rx, lthumb_rz: sign of z restored in frame 290",)
    assert [note.split(":")[0] for note in run.notes] == ["35_19", "35_19"]
    # Thumb and hand are one rigid body in these files, about 30 degrees apart.
    for data, side, trial, frame in ((walk, "l", 0, 289), (run, "r", 2, 25)):
        hand, thumb = data.select([f"{side}hand_rz", f"{side}thumb_rz"]).arrays[trial].T
        apart = np.rad2deg(np.abs(hand - thumb))
        assert abs(apart[frame] - 30) < 0.5


@real
def test_walking_bodies_are_human_on_every_frame(walks: Sequences) -> None:
    skeleton = load_skeleton(35)
    for array in walks.arrays[:3]:
        places = skeleton.positions(torch.from_numpy(array), channels=walks.channels)
        for parent, child in skeleton.edges:
            length = (places[:, child] - places[:, parent]).norm(dim=-1)
            assert float((length - skeleton.bones[child].length).abs().max()) < 1e-12
        height, toe = places[..., 1].amax(1), places[..., 1].amin(1)
        seconds = len(array) / 120
        pace = float((places[-1, 0] - places[0, 0]).norm()) / seconds
        assert 1.5 < float(height.mean()) < 1.9 and abs(float(toe.mean())) < 0.05
        assert 0.8 < pace < 1.8


@real
def test_the_acknowledgement_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    cmu_mocap.acknowledge.cache_clear()
    for _ in range(2):
        zoo.load_data("cmu-mocap/35_01")
    assert capsys.readouterr().err.count("NSF EIA-0196217") == 1


def test_unknown_names_and_options_are_told_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="no CMU movement '35-wlak'; did you mean 35-walk"):
        zoo.load_data("cmu-mocap/35-wlak")
    with pytest.raises(UnknownNameError, match="takes no option 'frame'; did you mean frames"):
        zoo.load_data("cmu-mocap/35-walk", frame=70)
    with pytest.raises(ValueError, match="angles must be one of joint, all; got 'some'"):
        zoo.load_data("cmu-mocap/35_01", angles="some")


def leg_folder(folder: Path) -> Path:
    """A folder with trial 90_01 of a one-legged subject, and none of what CMU's files have."""
    write(folder, "90.asf", ASF)
    write(folder, "90_01.amc", AMC)
    return folder


def test_a_folder_holds_the_files_themselves_or_those_of_all_data(tmp_path: Path) -> None:
    flat = zoo.load_data("cmu-mocap/90_01", folder=leg_folder(tmp_path), frames=None)
    assert flat.channels == ("femur_rx", "femur_ry", "femur_rz", "tibia_rx") and len(flat) == 1
    deep = tmp_path / "cmu-mocap" / "90"
    deep.mkdir(parents=True)
    leg_folder(deep)
    nested = zoo.load_data("cmu-mocap/90_01", folder=tmp_path, frames=None)
    assert torch.equal(flat.values, nested.values) and flat.groups["movement"] == ("unknown",)


def test_a_dropped_channel_that_varies_is_told(tmp_path: Path) -> None:
    for file, text in (("90.asf", ASF), ("90_01.amc", AMC)):
        write(tmp_path, file, text.replace("tibia", "lfingers"))
    data = zoo.load_data("cmu-mocap/90_01", folder=tmp_path, frames=None)
    assert "lfingers_rx" not in data.channels
    assert data.notes[0].startswith(
        "90_01: lfingers_rx is left out although its variance is 2.0e-02"
    )


def test_absent_files_say_how_to_get_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingDataError, match=f"35/35.asf is not in the folder {tmp_path}"):
        zoo.load_data("cmu-mocap/35_01", folder=tmp_path)
    monkeypatch.setenv("MOVEZOO_DATA", str(tmp_path))
    with pytest.raises(
        MissingDataError, match=r"no hash is known for 90/90\.asf.*MOVEZOO_DATA/cmu"
    ):
        zoo.load_data("cmu-mocap/90_01")


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The leg's files behind a web server of this machine, and an empty cache."""
    root = tmp_path / "served" / "90"
    root.mkdir(parents=True)
    leg_folder(root)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(tmp_path / "served"))  # type: ignore[arg-type]

        def log_message(self, *args: object) -> None:
            """Say nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{web.server_address[1]}/"
        web.shutdown()


def test_downloads_are_checked_and_kept(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MOVEZOO_DATA", raising=False)
    sums = {
        f"90/{name}": hashlib.sha256(text.encode()).hexdigest()
        for name, text in (("90.asf", ASF), ("90_01.amc", AMC))
    }
    monkeypatch.setattr(cmu_mocap, "BASE", server)
    monkeypatch.setattr(cmu_mocap, "HASHES", sums)
    first = zoo.load_data("cmu-mocap/90_01", frames=None)
    monkeypatch.setattr(cmu_mocap, "BASE", "http://127.0.0.1:9/")
    again = zoo.load_data("cmu-mocap/90_01", frames=None)
    assert torch.equal(first.values, again.values)


def test_files_with_another_hash_are_refused(server: str) -> None:
    with pytest.raises(FileFormatError, match=r"refused: .*hash"):
        download("90/90.asf", base=server, hashes={"90/90.asf": "0" * 64}, dataset="cmu-mocap")


def test_a_download_that_fails_says_what_to_do(server: str) -> None:
    known = {"90/91.asf": "0" * 64}
    with pytest.raises(MissingDataError, match=r"downloading .*90/91\.asf failed .* fetch it"):
        download("90/91.asf", base=server, hashes=known, dataset="cmu-mocap")


@real
def test_known_hashes_are_those_of_the_owners_files() -> None:
    for relative, expected in cmu_mocap.HASHES.items():
        path = Path(DATA, "cmu-mocap", relative)
        if path.is_file():
            assert hashlib.sha256(path.read_bytes()).hexdigest() == expected
            if path.suffix == ".amc" and path.stem.startswith("49"):
                assert len(read_amc(path, load_skeleton(49))) == 1102
