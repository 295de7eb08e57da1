"""What a process does at the moment, for whoever waits for it."""

from alpasim_plugin.core.stage import announce, shown_in, stages_in


def test_a_stage_is_seen_while_it_lasts_and_not_after(tmp_path):
    announce("nobody asked", 1, 2)
    with shown_in(tmp_path / "stages"):
        announce("fitting a", 3, 10)
        announce("fitting a", 4, 10)  # too soon to be worth a write
        (found,) = stages_in(tmp_path / "stages")
        assert (found.name, found.done, found.total) == ("fitting a", 3, 10)
        announce("driving a")
        assert [one.name for one in stages_in(tmp_path / "stages")] == ["driving a"]
        (tmp_path / "stages" / "1").write_text("{")  # written just now
        assert len(stages_in(tmp_path / "stages")) == 1
    (tmp_path / "stages" / "1").unlink()
    assert stages_in(tmp_path / "stages") == []
