"""Where the laboratory's tests are collected."""

from tests.laboratory import DISTRIBUTION, laboratory_is_installed


def test_laboratory_is_found_by_its_distribution_alone(tmp_path):
    assert not laboratory_is_installed([str(tmp_path)])
    facts = tmp_path / "alpasim_onefixer_lab-0.1.0.dist-info" / "METADATA"
    facts.parent.mkdir()
    facts.write_text(f"Metadata-Version: 2.1\nName: {DISTRIBUTION}\nVersion: 0.1.0\n")
    assert laboratory_is_installed([str(tmp_path)])
