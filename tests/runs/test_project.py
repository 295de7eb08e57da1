"""The commit of the user's project, asked of real repositories."""

import subprocess

import pytest

from alpasim_plugin.log.run_folder.records import Project
from alpasim_plugin.runs.provenance import project

WHO = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")


def git(folder, *words):
    return subprocess.run(
        ["git", *WHO, *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture(autouse=True)
def nothing_stated(monkeypatch, tmp_path):
    monkeypatch.delenv("SIMRUN_COMMIT", raising=False)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))


def test_a_commit_a_changed_file_and_a_detached_head(tmp_path):
    git(tmp_path, "init", "-q", "-b", "trunk")
    assert project(tmp_path).reason  # no commit yet
    (tmp_path / "policy.py").write_text("a")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    commit = git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "notes.txt").write_text("git does not follow it")
    below = tmp_path / "deeper"
    below.mkdir()
    found = project(below)
    assert found == Project(commit=commit, dirty=False, reason="")
    (tmp_path / "policy.py").write_text("b")
    git(tmp_path, "checkout", "-q", "--detach")
    assert project(tmp_path).dirty


def test_a_program_that_the_repository_names_is_not_run(tmp_path):
    spy = tmp_path / "spy"
    own = tmp_path / "own"
    spy.write_text(f"#!/bin/sh\necho $0 $@ >> {tmp_path}/was-run\ncat\n")
    spy.chmod(0o755)
    own.mkdir()
    git(own, "init", "-q")
    (own / "a").write_text("a")
    git(own, "add", "a")
    git(own, "commit", "-qm", "a")
    signed = git(own, "cat-file", "commit", "HEAD").replace(
        "\n\n", "\ngpgsig -----BEGIN PGP SIGNATURE-----\n \n -----END PGP SIGNATURE-----\n\n", 1
    )
    (tmp_path / "commit").write_text(signed + "\n")
    git(
        own,
        "update-ref",
        "HEAD",
        git(own, "hash-object", "-t", "commit", "-w", str(tmp_path / "commit")),
    )
    (own / ".gitattributes").write_text("* filter=x\n")
    for name in (
        "core.fsmonitor",
        "core.sshCommand",
        "gpg.program",
        "filter.x.clean",
        "filter.x.process",
        "core.alternateRefsCommand",
    ):
        git(own, "config", name, str(spy))
    for name, value in (
        ("log.showSignature", "true"),
        ("filter.x.required", "true"),
        ("protocol.ext.allow", "always"),
    ):
        git(own, "config", name, value)
    (own / "a").write_text("b")
    found = project(own)
    assert (found.commit, found.dirty) == (
        git(own, "-c", "log.showSignature=false", "rev-parse", "HEAD"),
        True,
    )
    for name, value in (
        ("remote.o.url", f"ext::{spy}"),
        ("remote.o.promisor", "true"),
        ("extensions.partialClone", "o"),
    ):
        git(own, "config", name, value)
    git(own, "config", "core.repositoryFormatVersion", "1")
    for path in (own / ".git" / "objects").glob("??/*"):  # what is missing would be fetched
        path.unlink()
    assert project(own).commit is None
    git(own, "config", "filter.y=z.clean", str(spy))
    assert project(own).commit is None
    assert not (tmp_path / "was-run").exists(), (tmp_path / "was-run").read_text()


def test_without_a_repository_or_without_git_it_is_said_why(tmp_path, monkeypatch):
    assert "not a git repository" in project(tmp_path).reason
    monkeypatch.setenv("SIMRUN_COMMIT", "3F2A9C1")
    assert project(tmp_path).commit == "3f2a9c1"
    monkeypatch.setenv("SIMRUN_COMMIT", "$CI_COMMIT")
    assert project(tmp_path).reason == "SIMRUN_COMMIT is no commit: '$ci_commit'"
    monkeypatch.delenv("SIMRUN_COMMIT")
    monkeypatch.setenv("PATH", "")
    assert project(tmp_path).reason == "git is not installed"
