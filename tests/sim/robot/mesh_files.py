"""A tetrahedron as a mesh file of each format, and a robot with a mesh."""

import json
import struct

import numpy as np
from tiny_urdf import INERTIAL, one_joint

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")


FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u4")


def stl():
    """Tetrahedron as binary STL."""
    facets = (np.zeros(3, "<f4").tobytes() + CORNERS[face].tobytes() + bytes(2) for face in FACES)
    return bytes(80) + struct.pack("<I", len(FACES)) + b"".join(facets)


def ascii_stl():
    lines = ["solid tetrahedron"]
    for face in FACES:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += ["  vertex {} {} {}".format(*CORNERS[corner]) for corner in face]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, "endsolid tetrahedron\n"]).encode()


def obj():
    lines = [
        *("v {} {} {}".format(*corner) for corner in CORNERS),
        *("f {} {} {}".format(*face + 1) for face in FACES),
    ]
    return "\n".join(lines).encode()


def dae():
    coordinates, indices = (
        " ".join(map(str, table.ravel().tolist())) for table in (CORNERS, FACES)
    )
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="12">{coordinates}</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y"
type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="4"><input semantic="VERTEX"
source="#v" offset="0"/><p>{indices}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()


def glb(**changed):
    binary = FACES.tobytes() + CORNERS.tobytes()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [
            {"componentType": 5125, "type": "SCALAR", "bufferView": 0, "count": 12},
            {
                "componentType": 5126,
                "type": "VEC3",
                "bufferView": 1,
                "count": 4,
                "min": [0] * 3,
                "max": [1] * 3,
            },
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 48},
        ],
        "buffers": [{"byteLength": 96}],
    }
    text = json.dumps(content | changed).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


GOOD = {
    "a.stl": stl(),
    "b.STL": stl(),
    "c.stl": ascii_stl(),
    "d.obj": obj(),
    "e.dae": dae(),
    "f.glb": glb(),
}


def arm(name):
    return one_joint(
        arm=INERTIAL + f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'
    )
