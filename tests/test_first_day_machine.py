"""A lab's first day: its cameras, what is wrong with its machine, and completion in its shell."""

import json
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tubesight.apps import doctor
from tubesight.apps.doctor import Check, check_cache, check_cameras, check_disk, check_opencv, check_port
from tubesight.cli.main import main
from tubesight.sources.devices import list_devices


def leave(*args: str) -> int:
    """Exit code of the command line."""
    with pytest.raises(SystemExit) as left:
        main(list(args))
    return int(left.value.code or 0)


def plug_in(root: Path, number: int, name: str, serial: str | None, index: int = 0) -> None:
    """Add a camera to a copy of the system's folders."""
    usb = root / f"sys/devices/usb1/{name.replace(' ', '_')}"
    interface = usb / "1.0"
    entry = interface / f"video4linux/video{number}"
    entry.mkdir(parents=True)
    (usb / "idProduct").write_text("0843\n")
    if serial:
        (usb / "serial").write_text(f"{serial}\n")
    (entry / "name").write_text(f"{name}\n")
    (entry / "index").write_text(f"{index}\n")
    (entry / "device").symlink_to(interface)
    listed = root / "sys/class/video4linux"
    listed.mkdir(parents=True, exist_ok=True)
    (listed / f"video{number}").symlink_to(entry)
    dev = root / "dev"
    (dev / "v4l/by-id").mkdir(parents=True, exist_ok=True)
    (dev / f"video{number}").touch()
    if serial:
        (dev / f"v4l/by-id/usb-{serial}-video-index{index}").symlink_to(f"../../video{number}")


def test_devices_by_name_and_serial(tmp_path: Path) -> None:
    plug_in(tmp_path, 10, "Camera B", None)
    plug_in(tmp_path, 2, "Camera A", "AB12")
    plug_in(tmp_path, 3, "Camera A", "AB12", index=1)
    found = list_devices(tmp_path)
    assert [(d.node, d.name, d.serial, d.readable) for d in found] == [
        (str(tmp_path / "dev/video2"), "Camera A", "AB12", True),
        (str(tmp_path / "dev/video10"), "Camera B", None, True),
    ]
    assert found[0].by_id == str(tmp_path / "dev/v4l/by-id/usb-AB12-video-index0")
    assert found[1].by_id is None
    assert list_devices(tmp_path / "nowhere") == ()


def test_devices_without_any(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("tubesight.sources.devices.list_devices", lambda: ())
    assert leave("devices") == 0
    assert "no camera found" in capsys.readouterr().out
    assert leave("devices", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"devices": []}


def test_doctor_prints_json_and_lines(capsys: pytest.CaptureFixture[str]) -> None:
    code = leave("doctor", "--json")
    report = json.loads(capsys.readouterr().out)
    checks = {check["name"]: check for check in report["checks"]}
    assert {"python", "tubesight", "numpy", "opencv wheel", "compiled code", "disk for results"} <= set(checks)
    assert len(checks) == len([c for c in report["checks"] if c["name"] != "camera"]) + ("camera" in checks)
    grades = [check["grade"] for check in report["checks"]]
    assert set(grades) <= {"ok", "warn", "bad"}
    assert (code, report["ok"]) == ((1, False) if "bad" in grades else (0, True))
    assert all(bool(check["remedy"]) == (check["grade"] != "ok") for check in report["checks"])
    assert leave("doctor") == code
    assert re.search(r"^ok +python ", capsys.readouterr().out, re.MULTILINE)


def test_doctor_fails_where_something_is_bad(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: (Check("thing", "bad", "broken", "mend it"),))
    assert leave("doctor") == 1
    out = capsys.readouterr().out
    assert "bad   thing  broken" in out
    assert "mend it" in out
    monkeypatch.setattr(doctor, "examine", lambda: (Check("thing", "warn", "old", "renew it"),))
    assert leave("doctor", "--json") == 0
    assert json.loads(capsys.readouterr().out)["ok"] is True


def test_requirements_are_compared() -> None:
    declared = [
        "numpy>=1.26",
        "scipy<1.0,>=0.9",
        "tubesight-none>=2",
        'tubesight-extra>=3; extra == "all"',
        'tubesight-extra>=3; extra == "plots"',
        "opencv-contrib-python-headless<6,>=4.12",
        'tubesight[plots]; extra == "all"',
    ]
    found = {check.name: check for check in doctor.check_requirements(declared)}
    assert {name: check.grade for name, check in found.items()} == {
        "numpy": "ok",
        "scipy": "bad",
        "tubesight-none": "bad",
        "tubesight-extra": "warn",
    }
    assert found["scipy"].remedy == "pip install 'scipy<1.0,>=0.9'"
    assert found["tubesight-extra"].remedy == "pip install 'tubesight[plots]'"


@pytest.mark.parametrize(
    ("version", "bounds", "right"),
    [
        ("4.12.0.88", "<6,>=4.12", True),
        ("6.0", "<6", False),
        ("5.9.9", "<6", True),
        ("2.0rc1", ">=2", True),
        ("1", "", True),
    ],
)
def test_versions(version: str, bounds: str, right: bool) -> None:
    assert doctor._within(version, bounds) is right


def test_one_opencv() -> None:
    wheel = "opencv-contrib-python-headless 5.0.0"
    assert check_opencv([wheel], []).grade == "ok"
    two = check_opencv([wheel, "opencv-python 4.12.0"], [])
    assert two.grade == "bad"
    assert two.remedy.startswith("pip uninstall -y opencv-python ")
    assert check_opencv([], []).grade == "warn"
    old = check_opencv([wheel], ["opencv-contrib-python-headless>=99"])
    assert (old.grade, old.remedy.split("; ")[1]) == ("bad", "pip install 'opencv-contrib-python-headless>=99'")


def test_cache_port_disk_and_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_cache(True).grade == "ok"
    assert "NUMBA_CACHE_DIR" in check_cache(False).remedy
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert check_port(port).grade == "warn"
    assert check_port(port).grade == "ok"
    assert check_disk("results", tmp_path / "nowhere").grade == "bad"
    usage = type("Usage", (), {"free": 5e7})
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
    assert check_disk("results", tmp_path).grade == "bad"
    assert [check.grade for check in check_cameras(tmp_path)] == ["ok"]
    plug_in(tmp_path, 0, "Camera A", "1")
    (tmp_path / "dev/video0").unlink()
    assert [(check.grade, "video" in check.remedy) for check in check_cameras(tmp_path)] == [("bad", True)]


def test_completion_is_installed(tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("tubesight")
    env = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run([program, "--install-completion", "bash"], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    assert "bash completion installed" in done.stdout
    assert "tubesight" in (tmp_path / ".bashrc").read_text()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script(shell: str) -> None:
    """The script for the shell, and what it gets when it asks for the commands that start with `do`."""
    program = Path(sys.executable).with_name("tubesight")
    show = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1", "PATH": "/usr/bin:/bin", "_TUBESIGHT_COMPLETE": ""}
    done = subprocess.run([program, "--show-completion", shell], capture_output=True, text=True, env=show)
    assert done.returncode == 0, done.stderr
    assert "_TUBESIGHT_COMPLETE" in done.stdout
    ask = {
        "bash": {"COMP_WORDS": "tubesight do", "COMP_CWORD": "1"},
        "zsh": {"_TYPER_COMPLETE_ARGS": "tubesight do"},
        "fish": {"_TYPER_COMPLETE_ARGS": "tubesight do", "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }[shell]
    env = show | ask | {"_TUBESIGHT_COMPLETE": f"complete_{shell}"}
    done = subprocess.run([program], capture_output=True, text=True, env=env)
    assert "doctor" in done.stdout
    assert "devices" not in done.stdout
