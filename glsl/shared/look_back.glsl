// Status words of a scan with decoupled look-back: a flag and a count. The count is the aggregate
// of a part of the input, or the inclusive prefix over the part and all preceding ones; 0 = not
// published yet.
const uint FLAG_AGGREGATE = 1u << 30, FLAG_INCLUSIVE = 2u << 30, COUNT_MASK = FLAG_AGGREGATE - 1u;

// A count that a loop left, as the operand of a subgroup operation: naga, which validates the
// shaders in tests, cannot read the value of a loop itself there.
uint counted(uint count) { return count & COUNT_MASK; }

// Failed polls before the predecessor is counted by the one that waits. A part takes some
// microseconds and a poll a fraction of one, so no GPU reaches this number. Lavapipe leaves the
// loops of a shader after 65535 rounds in all, which happened where the system had suspended the
// thread of the predecessor.
const uint MAX_SPINS = 1000u;
