"""Meshes to the bytes of a file: PLY, STL, OBJ, GLB, 3MF, VTP and MZ3.

Coordinates are mm in the space that the file names. trimesh writes PLY, STL, OBJ and GLB; the writers
here are for formats that it does not write, or (3MF) not twice alike. The same mesh gives the same bytes.
"""

import base64
import io
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, get_args
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from model.errors import InvalidParameter
from model.geometry import Space
from model.inference.mesh import Mesh, to_trimesh, transformed
from service.adapters.image_guard import LPS_TO_RAS
from service.colours import RAMP, SIGNED_RAMP

Writer = Callable[[Mesh, Mapping[str, str]], bytes]

SPACES: tuple[str, ...] = get_args(Space)
UNITS = "mm"
STL_HEADER_SIZE = 80
MZ3_MAGIC = 0x5A4D
MZ3_HAS_FACES, MZ3_HAS_VERTICES, MZ3_HAS_SCALARS = 1, 2, 8
#: ZIP has no earlier date; a fixed one keeps the bytes the same.
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_mesh(mesh: Mesh, format: str, *, space: str = "RAS", metadata: Mapping[str, object]) -> bytes:
    """A mesh as a file of a format, by its suffix.

    PLY, GLB, VTP and MZ3 carry the scalars; STL, OBJ and 3MF have no place for them. In GLB the vertices are
    mm as everywhere, and a node's matrix makes metres with Y up of them (X right, Y superior, Z posterior).

    Args:
        mesh: world RAS mm.
        format: ``ply``, ``stl``, ``obj``, ``glb``, ``3mf``, ``vtp`` or ``mz3``.
        space: coordinates of the file, ``RAS`` or ``LPS``; the vertices are converted.
        metadata: what else the file is to say, where its format has room.

    Raises:
        InvalidParameter: another format or space, or a mesh without faces.
    """
    writers = _writers()
    if format not in writers:
        raise InvalidParameter(f"The mesh format must be one of {', '.join(writers)}.", part="format")
    if space not in SPACES:
        raise InvalidParameter("The space of a mesh must be RAS or LPS.", part="space")
    if mesh.is_empty:
        raise InvalidParameter("Only a surface with at least one face can be written.", part="mesh")
    frame = {"space": space, "units": UNITS}
    said = {key: _one_line(value) for key, value in {**frame, **metadata, **frame}.items()}
    return writers[format](transformed(mesh, LPS_TO_RAS) if space == "LPS" else mesh, said)


def colours(values: Float[np.ndarray, "v"]) -> UInt8[np.ndarray, "v 4"]:
    """RGBA of scalars from zero to their maximum, and alike to both sides of zero where there are negative ones."""
    low, top = colour_range(values)
    ramp = SIGNED_RAMP if low < 0 else RAMP
    stops = np.linspace(-1.0 if low < 0 else 0.0, 1.0, len(ramp))
    place = values / top if top > 0 else np.zeros(len(values))
    channels = [np.interp(place, stops, [colour[channel] for colour in ramp]) for channel in range(3)]
    return np.asarray(np.rint(np.stack([*channels, np.full(len(values), 255.0)], axis=1)), np.uint8)


def colour_range(values: Float[np.ndarray, "v"]) -> tuple[float, float]:
    """Scalars at the first and the last colour of the ramp."""
    top = float(np.abs(values).max())
    return (-top if (values < 0).any() else 0.0), top


def _writers() -> dict[str, Writer]:
    return {
        "ply": _ply,
        "stl": _stl,
        "obj": _obj,
        "glb": _glb,
        "3mf": _three_mf,
        "vtp": _vtp,
        "mz3": _mz3,
    }


def _ply(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    written: bytes = export_ply(_single_precision(mesh), encoding="binary_little_endian", vertex_normal=True)
    start, _, rest = written.partition(b"comment")
    comments = "".join(f"comment {key} {value}\n" for key, value in said.items())
    return start + comments.encode("ascii", "replace") + rest.partition(b"\n")[2]


def _stl(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    header = "MorphoFlow " + " ".join(f"{key}={value}" for key, value in said.items())
    written: bytes = export_stl(to_trimesh(mesh))
    return header.encode("ascii", "replace")[:STL_HEADER_SIZE].ljust(STL_HEADER_SIZE) + written[STL_HEADER_SIZE:]


def _obj(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    # A backslash or a blank at the end of a comment would take the next line into it.
    header = "\n# ".join(f"{key} {value}".replace("\\", "/").strip() for key, value in said.items())
    write: Any = export_obj
    text: str = write(to_trimesh(mesh), include_normals=True, digits=6, header=header)
    return text.encode()


def _glb(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    body = to_trimesh(mesh)
    body.vertex_attributes.clear()
    for name, values in mesh.scalars.items():
        body.vertex_attributes[f"_{name.upper()}"] = values.astype(np.float32)
    body.metadata.update(said)
    if mesh.scalars:
        name, shown = next(iter(mesh.scalars.items()))
        body.visual = trimesh.visual.ColorVisuals(body, vertex_colors=colours(shown))
        low, high = colour_range(shown)
        body.metadata["colours"] = f"{name} from {low:.4g} to {high:.4g}"
    scene = trimesh.Scene(base_frame="world")
    scene.add_geometry(body, node_name="surface", geom_name="surface", transform=_to_gltf(said["space"]))
    write: Any = export_glb
    written: bytes = write(scene, include_normals=True)
    return written


def _to_gltf(space: str) -> Float[np.ndarray, "4 4"]:
    """From mm in a space to metres with X right, Y superior, Z posterior."""
    right, posterior = (1.0, -1.0) if space == "RAS" else (-1.0, 1.0)
    axes = np.array([[right, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, posterior, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] = axes / 1000.0
    return matrix


def _three_mf(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    types = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
    )
    relations = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
        '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
        'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
    )
    parts = {"[Content_Types].xml": types, "_rels/.rels": relations, "3D/3dmodel.model": _three_mf_model(mesh, said)}
    package = io.BytesIO()
    with zipfile.ZipFile(package, "w") as archive:
        for name, text in parts.items():
            archive.writestr(zipfile.ZipInfo(name, ZIP_EPOCH), text, zipfile.ZIP_DEFLATED)
    return package.getvalue()


def _three_mf_model(mesh: Mesh, said: Mapping[str, str]) -> str:
    vertices = "".join(f'<vertex x="{x:.5f}" y="{y:.5f}" z="{z:.5f}"/>' for x, y, z in mesh.vertices.tolist())
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in mesh.faces.tolist())
    description = escape("; ".join(f"{key} {value}" for key, value in said.items()))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<model unit="millimeter" xml:lang="en-GB" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f'<metadata name="Application">MorphoFlow</metadata><metadata name="Description">{description}</metadata>'
        f'<resources><object id="1" type="model"><mesh><vertices>{vertices}</vertices>'
        f'<triangles>{triangles}</triangles></mesh></object></resources><build><item objectid="1"/></build></model>'
    )


def _vtp(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    scalars = "".join(_vtk_array(name, values.astype("<f4")) for name, values in mesh.scalars.items())
    ends = np.arange(3, 3 * len(mesh.faces) + 1, 3, dtype="<i8")
    fields = "".join(_vtk_text(key, value) for key, value in said.items())
    return (
        '<?xml version="1.0"?>'
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64"><PolyData>'
        f"<FieldData>{fields}</FieldData>"
        f'<Piece NumberOfPoints="{len(mesh.vertices)}" NumberOfPolys="{len(mesh.faces)}">'
        f'<PointData Normals="Normals">{_vtk_array("Normals", mesh.normals.astype("<f4"))}{scalars}</PointData>'
        f"<Points>{_vtk_array('Points', mesh.vertices.astype('<f4'))}</Points>"
        f"<Polys>{_vtk_array('connectivity', mesh.faces.astype('<i8').ravel())}{_vtk_array('offsets', ends)}</Polys>"
        "</Piece></PolyData></VTKFile>"
    ).encode()


def _vtk_array(name: str, values: np.ndarray) -> str:
    kind = {"f": "Float32", "i": "Int64"}[values.dtype.kind]
    parts = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    coded = base64.b64encode(struct.pack("<Q", values.nbytes) + values.tobytes()).decode()
    return f'<DataArray type="{kind}" Name={quoteattr(name)}{parts} format="binary">{coded}</DataArray>'


def _vtk_text(name: str, value: str) -> str:
    codes = " ".join(str(code) for code in [*value.encode(), 0])
    return f'<Array type="String" Name={quoteattr(name)} NumberOfTuples="1" format="ascii">{codes}</Array>'


def _mz3(mesh: Mesh, said: Mapping[str, str]) -> bytes:
    content = MZ3_HAS_FACES | MZ3_HAS_VERTICES | (MZ3_HAS_SCALARS if mesh.scalars else 0)
    note = "\n".join(f"{key} {value}" for key, value in said.items()).encode()
    note += b" " * (-len(note) % 4)
    header = struct.pack("<HHIII", MZ3_MAGIC, content, len(mesh.faces), len(mesh.vertices), len(note))
    layers = [values.astype("<f4").tobytes() for values in mesh.scalars.values()]
    return b"".join([header, note, mesh.faces.astype("<i4").tobytes(), mesh.vertices.astype("<f4").tobytes(), *layers])


def _single_precision(mesh: Mesh) -> trimesh.Trimesh:
    body = to_trimesh(mesh)
    for name, values in mesh.scalars.items():
        body.vertex_attributes[name] = values.astype(np.float32)
    return body


def _one_line(value: object) -> str:
    return "".join(letter for letter in " ".join(str(value).split()) if letter.isprintable())
