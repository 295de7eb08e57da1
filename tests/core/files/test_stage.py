"""What a process does at the moment, for whoever waits for it."""

from alpasim_plugin.cli import output
from alpasim_plugin.cli.output import Progress
from alpasim_plugin.core.files.stage import announce, shown_in, stages_in


def test_a_stage_is_seen_while_it_lasts_and_not_after(tmp_path):
    announce("nobody asked")
    with shown_in(tmp_path / "stages"):
        announce("fitting a")
        announce("driving a")
        assert stages_in(tmp_path / "stages") == ["driving a"]
    assert stages_in(tmp_path / "stages") == []


def test_what_a_worker_does_is_shown_while_a_run_lasts(tmp_path, monkeypatch, capsys):
    progress = Progress()
    task = progress.add_task("rollouts", total=1)
    monkeypatch.setattr(output, "LINE_EVERY_S", -1.0)
    monkeypatch.setattr("time.sleep", lambda seconds: progress.advance(task))
    with shown_in(tmp_path):
        announce("fitting a: 3 of 10 updates")
        progress.watch(tmp_path)
    assert capsys.readouterr().err == "fitting a: 3 of 10 updates\n"
