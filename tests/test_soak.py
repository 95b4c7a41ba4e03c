"""``tubesight soak``: its figures, on a session of seconds."""

import json

import pytest

from tubesight.cli.main import main


def test_soak_reports_pairing_alarms_and_memory(capsys: pytest.CaptureFixture[str]) -> None:
    args = ["soak", "--seconds", "2", "--hz", "10", "--size", "640x360", "--instants", "2000", "--hours", "0.02"]
    with pytest.raises(SystemExit) as left:
        main([*args, "--json"])
    figures = json.loads(capsys.readouterr().out)
    assert not left.value.code
    assert figures["pairing"]["mixed"] == 0 and figures["pairing"]["pairs"] > 1000
    assert figures["figures"]["pairs"] > 5 and figures["false_alarms"] == 0
