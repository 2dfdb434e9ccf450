import json

import pytest
from splatvk import InputError
from splatvk.batch._manifest import read, row_of, shard_of


def write(path, *rows):
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return str(path)


def test_json_lines_give_rows(tmp_path):
    full = {
        "id": "a",
        "input": ["x/*.jpg", "s3://b/y"],
        "options": {"views": 4},
        "queries": ["chair"],
        "exports": ["glb"],
    }
    manifest = read(write(tmp_path / "m.jsonl", full, {"id": "b", "input": "/z"}))
    rows = {row["id"]: row for row in manifest.rows()}
    assert len(manifest) == 2
    assert rows["a"] == {**full, "input": [f"{tmp_path}/x/*.jpg", "s3://b/y"]}
    assert rows["b"] == {"id": "b", "input": ["/z"], "options": {}, "queries": [], "exports": []}


def test_csv_gives_rows(tmp_path):
    (tmp_path / "m.csv").write_text('id,input\na,"x, y"\nb,/z\n')
    rows = sorted(read(str(tmp_path / "m.csv")).rows(), key=lambda row: row["id"])
    assert [row["input"] for row in rows] == [[f"{tmp_path}/x, y"], ["/z"]]
    (tmp_path / "m.csv").write_text("id,photos\na,x\n")
    with pytest.raises(InputError, match="id,input"):
        read(str(tmp_path / "m.csv"))


def test_folders_give_rows(tmp_path):
    for name in ("a", "b", ".hidden"):
        (tmp_path / name).mkdir()
    (tmp_path / "note.txt").write_text("no folder")
    rows = {row["id"]: row["input"] for row in read(str(tmp_path)).rows()}
    assert rows == {"a": [str(tmp_path / "a")], "b": [str(tmp_path / "b")]}


def test_remote_manifest_is_read():
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").pipe("/m/rows.jsonl", b'{"id": "a", "input": "shop"}\n')
    assert [row["input"] for row in read("memory://m/rows.jsonl").rows()] == [["memory://m/shop"]]


@pytest.mark.parametrize(
    "row, message",
    [
        ({"id": "a", "input": "x", "view": 4}, "unknown key `view`"),
        ({"id": ".a", "input": "x"}, "begin with a letter"),
        ({"id": "_a", "input": "x"}, "begin with a letter"),
        ({"id": "a/b", "input": "x"}, "must be 1 to 100"),
        ({"id": "a" * 101, "input": "x"}, "must be 1 to 100"),
        ({"id": "a\n", "input": "x"}, "must be 1 to 100"),
        ({"id": "a"}, "no input"),
        ({"id": "a", "input": [1]}, "list of texts"),
        ({"id": "a", "input": "x", "options": [1]}, "JSON object"),
        ([1], "JSON object"),
    ],
)
def test_wrong_rows_are_refused(row, message):
    with pytest.raises(InputError, match=message):
        row_of(row)


def test_wrong_manifests_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"m.jsonl:2: id A is there twice"):
        read(write(tmp_path / "m.jsonl", {"id": "a", "input": "x"}, {"id": "A", "input": "y"}))
    (tmp_path / "m.jsonl").write_text('{"id": "a",\n')
    with pytest.raises(InputError, match=r"m.jsonl:1: no JSON"):
        read(str(tmp_path / "m.jsonl"))
    with pytest.raises(InputError, match="no rows"):
        read(write(tmp_path / "empty.jsonl"))
    with pytest.raises(InputError, match="is not there"):
        read(str(tmp_path / "none.jsonl"))


def test_shards_part_the_rows(tmp_path):
    path = write(tmp_path / "m.jsonl", *({"id": str(n), "input": "/x"} for n in range(7)))
    parts = [{row["id"] for row in read(path, (i, 3)).rows()} for i in range(3)]
    assert parts == [{"0", "3", "6"}, {"1", "4"}, {"2", "5"}]


@pytest.mark.parametrize(
    "env, shard",
    [
        ({"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_MIN": "5", "SLURM_ARRAY_TASK_COUNT": "4"}, (2, 4)),
        (
            {
                "SLURM_ARRAY_TASK_ID": "9",
                "SLURM_ARRAY_TASK_MIN": "1",
                "SLURM_ARRAY_TASK_COUNT": "3",
                "SLURM_ARRAY_TASK_STEP": "4",
            },
            (2, 3),
        ),
        ({"AWS_BATCH_JOB_ARRAY_INDEX": "0", "AWS_BATCH_JOB_ARRAY_SIZE": "8"}, (0, 8)),
        ({"BATCH_TASK_INDEX": "1", "BATCH_TASK_COUNT": "2"}, (1, 2)),
    ],
)
def test_shard_is_found_in_environment(monkeypatch, env, shard):
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    assert shard_of("auto") == shard


def test_wrong_shards_are_refused(monkeypatch):
    for text in ("3/3", "x", "1", "-1/2", "auto"):
        with pytest.raises(InputError, match="--shard"):
            shard_of(text)
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "1")
    with pytest.raises(InputError, match="auto/N"):
        shard_of("auto")
    assert shard_of("auto/8") == (1, 8)
