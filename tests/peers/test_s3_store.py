"""A batch that reads from and writes to a server that speaks S3 (moto, in its own environment)."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batch_bench import tables, write_scans, write_template
from peer_harness import free_port, peer, process, wait_for

pytestmark = pytest.mark.peers

SCANS = 6


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """What a user sets: the endpoint and the keys."""
    log, port = tmp_path_factory.mktemp("moto") / "log", free_port()
    with process(peer("moto"), "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port), log=log):
        wait_for("the S3 server answers", lambda: _answers(port), log)
        yield {
            **os.environ,
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
        }


def _answers(port: int) -> bool:
    with socket.socket() as asked:
        return asked.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def store(environment: dict[str, str]) -> Iterator[Any]:
    s3fs = pytest.importorskip("s3fs", reason="the extra 'store' is not installed")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        system = s3fs.S3FileSystem()
        system.mkdir("lab")
        yield system


def batch(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "amrepair", "batch", "detect", *words, "--json",
         "--workers", "1"],
        capture_output=True, text=True, env=environment, check=False, timeout=250,
    )  # fmt: skip


def test_scans_and_results_lie_in_a_bucket(
    environment: dict[str, str], store: Any, tmp_path: Path
) -> None:
    """The table of the bucket is that of the folder; what is there is not done again."""
    template = ("--template", str(write_template(tmp_path / "lug.safetensors")))
    scans = write_scans(tmp_path / "scans", SCANS)
    here = tmp_path / "here"
    assert batch(environment, str(scans), *template, "--out", str(here)).returncode == 0
    store.put(str(scans), "lab/scans", recursive=True)
    there = ("s3://lab/scans", *template, "--out", "s3://lab/out")
    first = batch(environment, *there)
    assert first.returncode == 0, first.stderr
    assert json.loads(first.stdout)["computed"] == SCANS
    assert store.cat_file("lab/out/table.csv") == tables(here)[0]
    assert store.cat_file("lab/out/overview.html") == tables(here)[1]
    gone = sorted(store.glob("lab/out/results/*/*.json"))[:2]
    store.rm(gone)
    store.invalidate_cache()
    again = json.loads(batch(environment, *there).stdout)
    assert (again["computed"], again["known_before"]) == (len(gone), SCANS - len(gone))
    assert store.cat_file("lab/out/table.csv") == tables(here)[0]
    manifest = "path,label\n" + "".join(f"s3://lab/scans/{k:05d}.ply,mk3\n" for k in range(3))
    store.pipe_file("lab/monday.csv", manifest.encode())
    listed = batch(environment, "s3://lab/monday.csv", *template, "--out", "s3://lab/monday")
    assert json.loads(listed.stdout)["scans"] == 3
    shutil.rmtree(here)


def test_a_store_that_refuses_is_one_sentence(
    environment: dict[str, str], store: Any, tmp_path: Path
) -> None:
    template = ("--template", str(write_template(tmp_path / "lug.safetensors")))
    done = batch(environment, "s3://nobody/scans", *template, "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    scans = write_scans(tmp_path / "scans", 1)
    done = batch(environment, str(scans), *template, "--out", "s3://nobody/out")
    assert done.returncode == 2
    said = json.loads(done.stdout)["error"]
    assert "s3://nobody/out" in said
    assert "NoSuchBucket" in said or "does not exist" in said
