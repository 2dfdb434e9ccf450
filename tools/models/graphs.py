"""The three networks, written as ONNX graphs from their papers' layer tables and the names in their weight files."""
import array
import math

from onnx_writer import Graph
from weight_files import Tensor


def _conv(g, x, w, bias=None, **attributes):
    inputs = [x, g.weight(w.dims, w.raw)]
    if bias is not None:
        inputs.append(g.weight(bias.dims, bias.raw))
    return g.add("Conv", inputs, kernel_shape=list(w.dims[2:]), **attributes)


def _norm(g, x, mean, var, scale=None, shift=None, epsilon=1e-5):
    n = mean.dims[0]
    scale = g.weight([n], scale.raw if scale else [1.0] * n)
    shift = g.weight([n], shift.raw if shift else [0.0] * n)
    inputs = [x, scale, shift, g.weight([n], mean.raw), g.weight([n], var.raw)]
    return g.add("BatchNormalization", inputs, epsilon=epsilon)


def xfeat(state):
    """XFeat (Potje et al., CVPR 2024): grey image [1, 1, H, W], H and W multiples of 32, to dense descriptors
    [1, 64, H/8, W/8], keypoint logits [1, 65, H/8, W/8] (8×8 cells, last channel: none) and reliability [1, 1, H/8, W/8]."""
    g = Graph("xfeat")
    image = g.input("image", [1, 1, "height", "width"])

    def plain(x, name):
        w = state[name + ".weight"]
        return _conv(g, x, w, state[name + ".bias"], pads=[w.dims[2] // 2] * 4)

    def layer(x, name, stride=1):
        w = state[name + ".layer.0.weight"]
        x = _conv(g, x, w, pads=[w.dims[2] // 2] * 4, strides=[stride, stride])
        x = _norm(g, x, state[name + ".layer.1.running_mean"], state[name + ".layer.1.running_var"])
        return g.add("Relu", [x])

    def block(x, name, strides):
        for i, s in enumerate(strides):
            x = layer(x, "%s.%d" % (name, i), s)
        return x

    x = g.add("InstanceNormalization", [image, g.weight([1], [1.0]), g.weight([1], [0.0])], epsilon=1e-5)
    pooled = g.add("AveragePool", [x], kernel_shape=[4, 4], strides=[4, 4])
    x1 = g.add("Add", [block(x, "block1", [1, 2, 1, 2]), plain(pooled, "skip1.1")])
    x3 = block(block(x1, "block2", [1, 1]), "block3", [2, 1, 1])
    x4 = block(x3, "block4", [2, 1, 1])
    x5 = block(x4, "block5", [2, 1, 1, 1])

    def up(y, by):
        scales = g.weight([4], [1.0, 1.0, by, by])
        return g.add("Resize", [y, "", scales], mode="linear", coordinate_transformation_mode="half_pixel")

    fused = g.add("Add", [g.add("Add", [x3, up(x4, 2.0)]), up(x5, 4.0)])
    fused = plain(block(fused, "block_fusion", [1, 1]), "block_fusion.2")
    g.add("Identity", [fused], "descriptors")
    g.add("Sigmoid", [plain(block(fused, "heatmap_head", [1, 1]), "heatmap_head.2")], "reliability")
    cells = g.add("SpaceToDepth", [x], blocksize=8)
    g.add("Identity", [plain(block(cells, "keypoint_head", [1, 1, 1]), "keypoint_head.3")], "keypoints")
    for name, channels in (("descriptors", 64), ("keypoints", 65), ("reliability", 1)):
        g.output(name, [1, channels, "height/8", "width/8"])
    return g.model()


# EfficientNet-Lite (Tan, 2020): repeats, kernel, stride, expansion, output channels of each stage before scaling.
_STAGES = [(1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192),
           (1, 3, 1, 6, 320)]


def efficientnet_lite(state, depth, mean, std):
    """RGB in [0, 1], [N, 3, H, W], to ImageNet logits [N, 1000]. Widths come with the weights; `depth` scales the
    repeats of all but the first and last stage. `mean`, `std`: what the weights were trained to see."""
    g = Graph("efficientnet_lite")
    image = g.input("image", ["n", 3, "height", "width"])
    x = g.add("Sub", [image, g.weight([1, 3, 1, 1], mean)])
    x = g.add("Div", [x, g.weight([1, 3, 1, 1], std)])

    def layer(x, conv, norm, stride=1, group=1, active=True):
        x = _conv(g, x, state[conv + ".weight"], auto_pad="SAME_UPPER", strides=[stride, stride], group=group)
        x = _norm(g, x, state[norm + ".running_mean"], state[norm + ".running_var"], state[norm + ".weight"],
                  state[norm + ".bias"], epsilon=1e-3)
        return g.add("Clip", [x, g.weight([], [0.0]), g.weight([], [6.0])]) if active else x

    x, index, width = layer(x, "_conv_stem", "_bn0", 2), 0, 32
    for stage, (repeats, _, stride, expand, _) in enumerate(_STAGES):
        if 0 < stage < len(_STAGES) - 1:
            repeats = math.ceil(depth * repeats)
        for i in range(repeats):
            p, y, s = "_blocks.%d." % index, x, stride if i == 0 else 1
            if expand != 1:
                y = layer(y, p + "_expand_conv", p + "_bn0")
            y = layer(y, p + "_depthwise_conv", p + "_bn1", s, state[p + "_depthwise_conv.weight"].dims[0])
            y = layer(y, p + "_project_conv", p + "_bn2", active=False)
            out = state[p + "_project_conv.weight"].dims[0]
            x = g.add("Add", [y, x]) if s == 1 and out == width else y
            width, index = out, index + 1
    if "_blocks.%d._project_conv.weight" % index in state:
        raise ValueError("the weights hold more blocks than this size has")
    x = layer(x, "_conv_head", "_bn1")
    x = g.add("Flatten", [g.add("GlobalAveragePool", [x])], axis=1)
    fc = state["_fc.weight"]
    g.add("Gemm", [x, g.weight(fc.dims, fc.raw), g.weight([1000], state["_fc.bias"].raw)], "logits", transB=1)
    g.output("logits", ["n", 1000])
    return g.model()


def _oihw(t, flip=False, gain=1.0):
    """A TensorFlow kernel [kh, kw, in, out] as [out, in, kh, kw]; `flip` reverses the input channels."""
    kh, kw, n_in, n_out = t.dims
    values, out = array.array("f"), array.array("f")
    values.frombytes(t.raw)
    for o in range(n_out):
        for i in range(n_in):
            out.extend(values[(n_in - 1 - i if flip else i) * n_out + o::n_in * n_out])
    if gain != 1.0:
        out = array.array("f", (v * gain for v in out))
    return Tensor((n_out, n_in, kh, kw), out.tobytes())


def hed(state):
    """HED (Xie & Tu, ICCV 2015): RGB in [0, 1], [1, 3, H, W], to edge probability [1, 1, H, W]."""
    g = Graph("hed")
    image = g.input("image", [1, 3, "height", "width"])
    # The network saw BGR in 0..255 less the Caffe mean; channel order and scale go into its first kernel.
    mean = [122.67892 / 255.0, 116.66877 / 255.0, 104.00699 / 255.0]
    x = g.add("Sub", [image, g.weight([1, 3, 1, 1], mean)])
    shape = g.add("Shape", [image])
    size = g.add("Slice", [shape, g.ints(2), g.ints(4)])
    size = g.add("Concat", [g.ints(1, 1), size], axis=0)
    sides = []
    for b, convs in enumerate([2, 2, 3, 3, 3], 1):
        if b > 1:
            x = g.add("MaxPool", [x], kernel_shape=[2, 2], strides=[2, 2], auto_pad="SAME_UPPER")
        for c in range(convs):
            name = "block%d/layers/conv2d%s/vars/" % (b, "_%d" % c if c else "")
            first = b == 1 and c == 0
            w = _oihw(state[name + "0"], flip=first, gain=255.0 if first else 1.0)
            x = g.add("Relu", [_conv(g, x, w, state[name + "1"], pads=[1, 1, 1, 1])])
        side = _conv(g, x, _oihw(state["dsn%d/vars/0" % b]), state["dsn%d/vars/1" % b])
        if b > 1:
            side = g.add("Resize", [side, "", "", size], mode="linear", coordinate_transformation_mode="half_pixel")
        sides.append(side)
    fused = _conv(g, g.add("Concat", sides, axis=1), _oihw(state["fuse/vars/0"]), state["fuse/vars/1"])
    g.add("Sigmoid", [fused], "edges")
    g.output("edges", [1, 1, "height", "width"])
    return g.model()
