"""Writes ONNX files, byte for byte the same on every machine: the protobuf wire format of the few messages needed.

Field numbers are those of the published onnx.proto3 (ModelProto, GraphProto, NodeProto, TensorProto, ...).
"""
import struct

FLOAT, INT64 = 1, 7  # TensorProto.DataType


def _varint(n):
    out = bytearray()
    n &= (1 << 64) - 1  # negative int64 are written as ten-byte two's complement
    while n > 0x7F:
        out.append(n & 0x7F | 0x80)
        n >>= 7
    out.append(n)
    return bytes(out)


def _int(field, n):
    return _varint(field << 3) + _varint(n)


def _bytes(field, data):
    if isinstance(data, str):
        data = data.encode()
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _attribute(name, value):
    out = _bytes(1, name)
    if isinstance(value, float):
        return out + _varint(2 << 3 | 5) + struct.pack("<f", value) + _int(20, 1)
    if isinstance(value, int):
        return out + _int(3, value) + _int(20, 2)
    if isinstance(value, str):
        return out + _bytes(4, value) + _int(20, 3)
    return out + b"".join(_int(8, v) for v in value) + _int(20, 7)


def _value_info(name, dims):
    shape = b"".join(_bytes(1, _bytes(2, d) if isinstance(d, str) else _int(1, d)) for d in dims)
    return _bytes(1, name) + _bytes(2, _bytes(1, _int(1, FLOAT) + _bytes(2, shape)))


class Graph:
    """Collects nodes and weights; every `add` returns the name of the node's output."""

    def __init__(self, name):
        self.name, self.nodes, self.weights, self.count = name, [], [], 0
        self.inputs, self.outputs = [], []

    def input(self, name, dims):
        self.inputs.append(_value_info(name, dims))
        return name

    def output(self, name, dims):
        self.outputs.append(_value_info(name, dims))

    def weight(self, dims, raw, kind=FLOAT):
        """A constant: `raw` is little-endian bytes, or a list of numbers."""
        if not isinstance(raw, bytes):
            raw = struct.pack("<%d%s" % (len(raw), "f" if kind == FLOAT else "q"), *raw)
        size = 4 if kind == FLOAT else 8
        expected = size
        for d in dims:
            expected *= d
        if len(raw) != expected:
            raise ValueError("weight of shape %s has %d bytes, expected %d" % (dims, len(raw), expected))
        name = "w%d" % len(self.weights)
        dims = b"".join(_int(1, d) for d in dims)
        self.weights.append(dims + _int(2, kind) + _bytes(8, name) + _bytes(9, raw))
        return name

    def ints(self, *values):
        return self.weight([len(values)], list(values), INT64)

    def add(self, op, inputs, output=None, **attributes):
        if output is None:
            self.count += 1
            output = "t%d" % self.count
        node = b"".join(_bytes(1, i) for i in inputs) + _bytes(2, output) + _bytes(3, output) + _bytes(4, op)
        node += b"".join(_bytes(5, _attribute(k, v)) for k, v in sorted(attributes.items()))
        self.nodes.append(node)
        return output

    def model(self):
        graph = b"".join(_bytes(1, n) for n in self.nodes) + _bytes(2, self.name)
        graph += b"".join(_bytes(5, w) for w in self.weights)
        graph += b"".join(_bytes(11, i) for i in self.inputs) + b"".join(_bytes(12, o) for o in self.outputs)
        # IR version 8 and operator set 17: understood by every ONNX Runtime since 1.12.
        return _int(1, 8) + _bytes(2, "splatvk tools/models") + _bytes(7, graph) + _bytes(8, _bytes(1, "") + _int(2, 17))
