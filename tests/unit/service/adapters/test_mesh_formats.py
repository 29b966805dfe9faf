"""Each format is read back by another reader than its writer's: trimesh, or the format's own definition."""

import base64
import io
import json
import struct
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InvalidParameter
from model.inference.isosurface import extract_surface
from model.inference.mesh import Mesh, empty_mesh, volume_ml
from service.adapters.mesh_formats import colours, write_mesh
from service.ports import MeshFormat
from tests.analytic_shapes import Box, Ellipsoid
from tests.service_parts import tetrahedron

SHAPE = Ellipsoid((7.0, 9.0, 12.0), np.array([30.0, -12.0, 5.0]))
METADATA = {"model": "hippocampus", "version": "1.2.0", "seed": 3}
FORMATS = [format.value for format in MeshFormat]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    low, high = SHAPE.centre - 14.0, SHAPE.centre + 14.0
    surface = extract_surface(SHAPE.logits, low, high, 1.0, gradient=SHAPE.logits_and_gradients)
    return surface.with_scalars(surface_sd_mm=0.1 + np.abs(surface.vertices[:, 2]) / 50.0)


def read_ply(data):
    body = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    values = body.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([values[name] for name in ("nx", "ny", "nz")], axis=1).reshape(-1, 3)
    return body.vertices, body.faces, normals, {"surface_sd_mm": np.ravel(values["surface_sd_mm"])}


def read_stl(data):
    body = trimesh.load(io.BytesIO(data), file_type="stl", process=False)
    return body.vertices, body.faces, None, {}


def read_obj(data):
    body = trimesh.load(io.BytesIO(data), file_type="obj", process=False, maintain_order=True)
    return body.vertices, body.faces, body.vertex_normals, {}


def read_glb(data):
    body = trimesh.load(io.BytesIO(data), file_type="glb", process=False).geometry["surface"]
    return (
        body.vertices,
        body.faces,
        body.vertex_normals,
        {"surface_sd_mm": np.ravel(body.vertex_attributes["_SURFACE_SD_MM"])},
    )


def read_3mf(data):
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    names = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    assert model.get("unit") == "millimeter"
    vertices = [[float(each.get(axis)) for axis in "xyz"] for each in model.iterfind(".//m:vertex", names)]
    faces = [
        [int(each.get(corner)) for corner in ("v1", "v2", "v3")] for each in model.iterfind(".//m:triangle", names)
    ]
    return np.array(vertices), np.array(faces), None, {}


def read_vtp(data):
    root = ElementTree.fromstring(data)
    arrays = {}
    for each in root.iter("DataArray"):
        raw = base64.b64decode(each.text)
        assert struct.unpack("<Q", raw[:8])[0] == len(raw) - 8
        values = np.frombuffer(raw[8:], {"Float32": "<f4", "Int64": "<i8"}[each.get("type")])
        arrays[each.get("Name")] = values.reshape(-1, int(each.get("NumberOfComponents", 1)))
    np.testing.assert_array_equal(np.diff(np.ravel(arrays["offsets"]), prepend=0), 3)
    faces = arrays["connectivity"].reshape(-1, 3)
    return arrays["Points"], faces, arrays["Normals"], {"surface_sd_mm": np.ravel(arrays["surface_sd_mm"])}


def read_mz3(data):
    magic, content, face_count, vertex_count, skip = struct.unpack("<HHIII", data[:16])
    assert (magic, content) == (0x5A4D, 1 + 2 + 8)
    body = io.BytesIO(data[16 + skip :])
    faces = np.frombuffer(body.read(12 * face_count), "<i4").reshape(-1, 3)
    vertices = np.frombuffer(body.read(12 * vertex_count), "<f4").reshape(-1, 3)
    scalars = np.frombuffer(body.read(4 * vertex_count), "<f4")
    assert not body.read()
    return vertices, faces, None, {"surface_sd_mm": scalars}


READERS = {
    "ply": read_ply,
    "stl": read_stl,
    "obj": read_obj,
    "glb": read_glb,
    "3mf": read_3mf,
    "vtp": read_vtp,
    "mz3": read_mz3,
}


@pytest.mark.parametrize("format", FORMATS)
def test_what_is_written_is_read_back(mesh, format):
    vertices, faces, normals, scalars = READERS[format](write_mesh(mesh, format, metadata=METADATA))
    assert faces.shape == mesh.faces.shape
    np.testing.assert_allclose(vertices[faces], mesh.vertices[mesh.faces], atol=1e-5)
    if normals is not None:
        np.testing.assert_allclose(normals, mesh.normals, atol=1e-5)
    for name, values in scalars.items():
        np.testing.assert_allclose(values, mesh.scalars[name], rtol=1e-6)


@pytest.mark.parametrize("format", FORMATS)
def test_lps_turns_about_the_body_axis_and_stays_right_side_out(mesh, format):
    data = write_mesh(mesh, format, space="LPS", metadata=METADATA)
    vertices, faces, normals, _ = READERS[format](data)
    np.testing.assert_allclose(vertices[faces], (mesh.vertices * [-1.0, -1.0, 1.0])[mesh.faces], atol=1e-5)
    body = Mesh(np.array(vertices, float), np.array(faces), np.array(vertices, float))
    assert volume_ml(body) == pytest.approx(volume_ml(mesh), rel=1e-5)
    if normals is not None:
        np.testing.assert_allclose(normals, mesh.normals * [-1.0, -1.0, 1.0], atol=1e-5)


@pytest.mark.parametrize("format", FORMATS)
def test_same_mesh_gives_the_same_bytes(mesh, format):
    twin = Mesh(mesh.vertices.copy(), mesh.faces.copy(), mesh.normals.copy(), dict(mesh.scalars))
    assert write_mesh(mesh, format, metadata=METADATA) == write_mesh(twin, format, metadata=METADATA)


@pytest.mark.parametrize("format", FORMATS)
def test_mesh_without_scalars_can_be_written(mesh, format):
    plain = Mesh(mesh.vertices, mesh.faces, mesh.normals)
    assert len(write_mesh(plain, format, metadata={})) <= len(write_mesh(mesh, format, metadata={}))


@pytest.mark.parametrize("space", ["RAS", "LPS"])
@pytest.mark.parametrize("format", FORMATS)
def test_file_says_its_space_and_unit(mesh, format, space):
    data = write_mesh(mesh, format, space=space, metadata=METADATA | {"space": "nowhere"})
    if format == "vtp":
        root = ElementTree.fromstring(data)
        said = {each.get("Name"): bytes(map(int, each.text.split()))[:-1].decode() for each in root.iter("Array")}
        assert said == {"space": space, "units": "mm", "model": "hippocampus", "version": "1.2.0", "seed": "3"}
        return
    if format == "3mf":
        data = zipfile.ZipFile(io.BytesIO(data)).read("3D/3dmodel.model")
    separator = {"stl": "=", "glb": '":"'}.get(format, " ")
    for words in (("space", space), ("units", "mm"), ("model", "hippocampus")):
        assert separator.join(words).encode() in data


def test_stl_header_has_its_size_and_is_not_taken_for_text(mesh):
    data = write_mesh(mesh, "stl", metadata={"digest": "f" * 64})
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert data[:80].startswith(b"MorphoFlow space=RAS units=mm")
    assert struct.unpack("<I", data[80:84])[0] == len(mesh.faces)


@pytest.mark.parametrize("space", ["RAS", "LPS"])
def test_gltf_node_makes_metres_with_y_up(mesh, space):
    data = write_mesh(mesh, "glb", space=space, metadata=METADATA)
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    right, anterior, superior = (mesh.vertices / 1000.0).T
    in_scene = scene.to_mesh()
    np.testing.assert_allclose(in_scene.vertices, np.stack([right, superior, -anterior], axis=1), atol=1e-7)
    assert in_scene.volume > 0


def test_gltf_carries_colours_and_scalars(mesh):
    data = write_mesh(mesh, "glb", metadata=METADATA)
    length = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + length])
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    assert {"POSITION", "NORMAL", "COLOR_0", "_SURFACE_SD_MM"} <= attributes.keys()
    accessor = tree["accessors"][attributes["COLOR_0"]]
    assert accessor["normalized"]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 28 + length + view.get("byteOffset", 0)
    written = np.frombuffer(data[start : start + view["byteLength"]], np.uint8).reshape(-1, 4)
    np.testing.assert_array_equal(written, colours(mesh.scalars["surface_sd_mm"]))


@given(st.lists(st.floats(0.0, 10.0), min_size=2, max_size=20))
def test_larger_scalars_are_darker(values):
    ordered = np.sort(np.array(values))
    rgba = colours(ordered).astype(int)
    assert (np.diff(rgba[:, 1]) <= 0).all()
    assert (rgba[:, 3] == 255).all()
    if ordered[-1] > 0:
        np.testing.assert_array_equal(rgba[-1], [127, 39, 4, 255])


@given(st.lists(st.floats(0.1, 10.0), min_size=1, max_size=10))
def test_scalars_of_both_signs_are_coloured_alike_to_both_sides_of_zero(values):
    sizes = np.array(values)
    rgba = colours(np.concatenate([sizes, -sizes, [0.0]]))
    np.testing.assert_array_equal(rgba[-1], [247, 247, 247, 255])
    np.testing.assert_array_equal(rgba[np.argmax(sizes)], [127, 39, 4, 255])
    np.testing.assert_array_equal(rgba[len(sizes) + np.argmax(sizes)], [5, 48, 97, 255])


@given(st.text(max_size=40))
def test_no_metadata_breaks_a_file(text):
    box = Box((0.5, 0.5, 0.5)).surface
    box = box.with_scalars(surface_sd_mm=np.arange(8.0))
    for format in FORMATS:
        _, faces, _, _ = READERS[format](write_mesh(box, format, metadata={"note": text}))
        assert len(faces) == 12


@pytest.mark.parametrize(
    ("format", "space", "part"), [("blend", "RAS", "format"), ("ply", "RSA", "space"), ("PLY", "RAS", "format")]
)
def test_unknown_formats_and_spaces_are_refused(mesh, format, space, part):
    with pytest.raises(InvalidParameter) as refusal:
        write_mesh(mesh, format, space=space, metadata={})
    assert refusal.value.part == part


@pytest.mark.parametrize("format", FORMATS)
def test_empty_mesh_is_refused(format):
    with pytest.raises(InvalidParameter):
        write_mesh(empty_mesh(), format, metadata={})


@pytest.mark.parametrize(("values", "said"), [((0.0, 1.5, 0.5, 1.0), "0 to 1.5"), ((-2.0, 1.5, 0.5, 1.0), "-2 to 2")])
def test_gltf_says_the_scalars_of_the_first_colour_and_the_last(values, said):
    mesh = tetrahedron({"signed_distance_mm": np.array(values)})
    data = write_mesh(mesh, "glb", metadata=METADATA)
    assert f"signed_distance_mm from {said}".encode() in data
