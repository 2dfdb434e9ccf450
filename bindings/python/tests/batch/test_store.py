import threading

from splatvk.batch._store import ABSENT, open_store


def test_new_file_is_put_once(place):
    store = open_store(place)
    assert store.version("a/x.json") == ABSENT
    assert store.read("a/x.json") is None
    assert store.put_if("a/x.json", b"first", ABSENT)
    assert not store.put_if("a/x.json", b"second", ABSENT)
    assert store.read("a/x.json") == b"first"
    assert store.names("a") == ["x.json"]


def test_replacement_needs_the_version(place):
    store = open_store(place)
    store.put("a/x.json", b"first")
    old = store.version("a/x.json")
    assert store.put_if("a/x.json", b"second", old)
    if not place.startswith("memory:"):
        assert not store.put_if("a/x.json", b"third", old)
        assert store.read("a/x.json") == b"second"
        store.delete("a/x.json")
        assert not store.put_if("a/x.json", b"third", old)


def test_one_of_many_writers_wins(place):
    if place.startswith("memory:"):
        return
    store, wins = open_store(place), []
    for version in ("new", "old"):
        tag = ABSENT if version == "new" else store.version("a/x.json")

        def put(number, tag=tag, version=version):
            # Equal contents have equal versions: no writer puts what was there before.
            wins.append(store.put_if("a/x.json", f"{version} {number}".encode(), tag))

        puts = [threading.Thread(target=put, args=(n,)) for n in range(8)]
        for thread in puts:
            thread.start()
        for thread in puts:
            thread.join()
        assert wins.count(True) == 1, version
        wins.clear()
    assert store.names("a") == ["x.json"]


def test_folders_are_uploaded_and_deleted(place, tmp_path):
    folder = tmp_path / "result"
    (folder / "scene" / "deep").mkdir(parents=True)
    (folder / "scene" / "deep" / "a.bin").write_bytes(b"1" * 1000)
    (folder / "b.bin").write_bytes(b"")
    store = open_store(place)
    store.upload(folder, "row/attempt")
    assert store.names("row") == ["attempt"]
    assert store.names("row/attempt") == ["b.bin", "scene"]
    assert store.read("row/attempt/scene/deep/a.bin") == b"1" * 1000
    store.delete("row/attempt")
    store.delete("row/attempt")
    assert store.names("row") == []
