"""`run_row` under other schedulers, as docs/use/cluster.md shows it."""

import json
import sys
from functools import partial

import pytest
from splatvk.batch import run_row


@pytest.fixture
def rows(photos):
    good = [{"id": f"row-{n}", "input": str(photos), "exports": ["glb"]} for n in range(4)]
    return [*good, {"id": "bad", "input": str(photos), "options": {"refuse": 1}}]


def stored(out):
    return sorted(p.parent.name for p in out.glob("*/_SUCCESS.json"))


def test_dask_maps_rows(rows, tmp_path):
    distributed = pytest.importorskip("distributed")
    out = tmp_path / "out"
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, resources={"GPU": 1}
    )
    with cluster, distributed.Client(cluster) as client:
        made = partial(run_row, retries=2)
        outcomes = client.gather(
            client.map(made, rows, out=str(out), timeout=60, resources={"GPU": 1}, pure=False)
        )
    assert [o["state"] for o in outcomes] == ["done"] * 4 + ["failed"]
    assert outcomes[4]["kind"] == "refused"
    assert stored(out) == [f"row-{n}" for n in range(4)]


def test_spark_maps_rows(rows, tmp_path, monkeypatch):
    sql = pytest.importorskip("pyspark.sql")
    pytest.importorskip("pyarrow")
    monkeypatch.setenv("SPARK_LOCAL_IP", "127.0.0.1")
    monkeypatch.setenv("PYSPARK_PYTHON", sys.executable)
    out, manifest = str(tmp_path / "out"), tmp_path / "m.jsonl"
    manifest.write_text("".join(json.dumps(row) + "\n" for row in rows))

    def make(frames):
        import pandas
        from splatvk.batch import run_row

        for frame in frames:
            outcomes = [run_row(json.loads(row), out, retries=2) for row in frame["row"]]
            yield pandas.DataFrame(
                {"id": [o["id"] for o in outcomes], "state": [o["state"] for o in outcomes]}
            )

    spark = sql.SparkSession.builder.master("local[2]").config("spark.ui.enabled", "false").getOrCreate()
    try:
        frame = spark.read.text(str(manifest)).withColumnRenamed("value", "row")
        found = frame.repartition(3).mapInPandas(make, "id string, state string").collect()
    finally:
        spark.stop()
    assert sorted((r.id, r.state) for r in found) == [("bad", "failed")] + [
        (f"row-{n}", "done") for n in range(4)
    ]
    assert stored(tmp_path / "out") == [f"row-{n}" for n in range(4)]
