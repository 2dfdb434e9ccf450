"""Reads weight files as plain data: torch zip files, torch's old pickle stream, and HDF5 as Keras writes it.

Unpickling can run code, so the unpickler here knows only the few names that rebuild tensors; anything else is an error.
"""
import array
import collections
import io
import itertools
import pickle
import struct
import zipfile

Tensor = collections.namedtuple("Tensor", "dims raw")  # row-major, little-endian
_SIZES = {"FloatStorage": 4, "LongStorage": 8}


class _Pending:
    """A view into a storage whose bytes may only be known later (old format: they follow the pickle)."""

    def __init__(self, storage, offset, size, stride):
        self.storage, self.offset, self.size, self.stride = storage, offset, tuple(size), tuple(stride)

    def tensor(self, storages):
        kind, key = self.storage
        values = array.array("f" if kind == "FloatStorage" else "q")
        values.frombytes(storages[key])
        last = self.offset + sum((n - 1) * s for n, s in zip(self.size, self.stride))
        if last >= len(values):
            raise ValueError("tensor of shape %s reaches past the end of its storage" % (self.size,))
        out = array.array(values.typecode)
        size, stride = self.size or (1,), self.stride or (1,)
        step = max(1, stride[-1])
        # Kernels converted from TensorFlow are stored transposed: gather along the last axis.
        for index in itertools.product(*(range(n) for n in size[:-1])):
            start = self.offset + sum(i * s for i, s in zip(index, stride))
            out.extend(values[start:start + (size[-1] - 1) * step + 1:step])
        return Tensor(self.size, out.tobytes())


class _Unpickler(pickle.Unpickler):
    def find_class(self, module, name):
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) in (("torch._utils", "_rebuild_tensor_v2"), ("torch._utils", "_rebuild_tensor")):
            return lambda storage, offset, size, stride, *_: _Pending(storage, offset, size, stride)
        if module == "torch" and name in _SIZES:
            return name
        raise pickle.UnpicklingError("%s.%s is not a name that weights need" % (module, name))

    def persistent_load(self, pid):
        return (pid[1], pid[2])  # ("storage", kind, key, location, count, ...)


def torch_zip(data):
    """name -> Tensor of a file written by torch.save since 1.6."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    pickled = [n for n in archive.namelist() if n.endswith("/data.pkl")]
    root = pickled[0][:-len("data.pkl")]
    state = _Unpickler(io.BytesIO(archive.read(pickled[0]))).load()
    keys = {v.storage[1] for v in state.values() if isinstance(v, _Pending)}
    storages = {k: archive.read(root + "data/" + k) for k in keys}
    return {k: v.tensor(storages) for k, v in state.items() if isinstance(v, _Pending)}


def torch_stream(data):
    """name -> Tensor of a file written by torch.save before 1.6: four pickles, then the storages."""
    f = io.BytesIO(data)
    if _Unpickler(f).load() != 0x1950A86A20F9469CFC6C or _Unpickler(f).load() != 1001:
        raise ValueError("not a torch weight file of the old format")
    if not _Unpickler(f).load()["little_endian"]:
        raise ValueError("big-endian torch files are not read")
    state = _Unpickler(f).load()
    kinds = {v.storage[1]: v.storage[0] for v in state.values() if isinstance(v, _Pending)}
    storages = {}
    for key in _Unpickler(f).load():
        count, = struct.unpack("<q", f.read(8))
        storages[key] = f.read(count * _SIZES[kinds[key]])
    return {k: v.tensor(storages) for k, v in state.items() if isinstance(v, _Pending)}


class _Hdf5:
    """Just enough of HDF5: superblock 0, groups as symbol tables, version-1 object headers, contiguous float32."""

    def __init__(self, data):
        if data[:8] != b"\x89HDF\r\n\x1a\n" or data[8] != 0 or data[13:15] != b"\x08\x08":
            raise ValueError("not an HDF5 file with superblock 0 and 8-byte offsets")
        self.data, self.found = data, {}
        self.walk(self.u64(24 + 32 + 8), "")

    def u16(self, at):
        return struct.unpack_from("<H", self.data, at)[0]

    def u32(self, at):
        return struct.unpack_from("<I", self.data, at)[0]

    def u64(self, at):
        return struct.unpack_from("<Q", self.data, at)[0]

    def messages(self, at):
        blocks, left = [(at + 16, self.u32(at + 8))], self.u16(at + 2)
        while blocks and left:
            at, size = blocks.pop(0)
            end = at + size
            while at + 8 <= end and left:
                kind, length = self.u16(at), self.u16(at + 2)
                if kind == 0x10:  # continuation
                    blocks.append((self.u64(at + 8), self.u64(at + 16)))
                yield kind, at + 8
                at, left = at + 8 + length, left - 1

    def walk(self, at, path):
        parts = dict(self.messages(at))
        if 0x11 in parts:  # symbol table: a B-tree of names and the heap that holds them
            heap = self.u64(self.u64(parts[0x11] + 8) + 24)
            self.tree(self.u64(parts[0x11]), heap, path)
        elif 0x08 in parts:  # data layout
            space, kind, layout = parts[0x01], parts[0x03], parts[0x08]
            if self.data[space] != 1 or self.data[kind] & 15 != 1 or self.u32(kind + 4) != 4:
                raise ValueError("%s is not float32" % path)
            if self.data[layout] != 3 or self.data[layout + 1] != 1:
                raise ValueError("%s is not stored contiguously" % path)
            dims = tuple(self.u64(space + 8 + 8 * i) for i in range(self.data[space + 1]))
            start, size = self.u64(layout + 2), self.u64(layout + 10)
            self.found[path] = Tensor(dims, self.data[start:start + size])

    def tree(self, at, heap, path):
        if self.data[at:at + 4] == b"SNOD":
            for i in range(self.u16(at + 6)):
                entry = at + 8 + 40 * i
                start = heap + self.u64(entry)
                name = self.data[start:self.data.index(b"\0", start)].decode()
                self.walk(self.u64(entry + 8), path + "/" + name if path else name)
        else:
            for i in range(self.u16(at + 6)):
                self.tree(self.u64(at + 24 + 8 + 16 * i), heap, path)


def hdf5(data):
    """path -> Tensor of every dataset."""
    return _Hdf5(data).found
