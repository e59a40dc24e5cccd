"""PhysX's filter of pairs of shapes, as SAPIEN sets it up."""


def may_touch(first, second):
    """Return whether two shapes of different bodies, with these four words each, may touch."""
    if first[3] >> 16 != second[3] >> 16:
        return False
    if first[2] & second[2] and first[3] & 0xFFFF == second[3] & 0xFFFF:
        return False
    return bool(first[0] & second[1] or second[0] & first[1])
