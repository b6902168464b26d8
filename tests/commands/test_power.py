"""`e2rl power`."""

import pytest

from e2rl.commands.power import main


def test_it_says_what_a_ratio_takes_and_what_scenes_show(capsys):
    main(["--rate", "0.6", "--ratio", "0.75", "--scenes", "5000"])
    needed, shown = capsys.readouterr().out.splitlines()
    assert needed.startswith("0.6 to 0.45 of scenes: seen with 176 scenes")
    assert shown == "5,000 scenes show a fall to 0.95 times or less"


def test_neither_ratio_nor_scenes_is_an_error(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--rate", "0.1"])
    assert stop.value.code == 2
    assert "give --ratio, --scenes, or both" in capsys.readouterr().err
