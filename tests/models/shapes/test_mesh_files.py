"""Mesh files: what was written is read, by ourselves and by trimesh; what is broken is refused and named."""

from __future__ import annotations

import os
import struct
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from models import ModelError
from models.checks import Array
from models.files import INPUT_LIMITS
from models.shapes import mesh_files
from models.shapes.mesh_files import Faces, distinct_rows, find_mesh, read_mesh, read_painted_mesh
from tests.models.robot.pinocchio_robots import collection

CORNERS = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.1, 0.1, 0.5]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def surface(vertices: Array, faces: Faces) -> Array:
    """Corners of the triangles, each turned so that the least comes first, in order: the same for the same surface."""
    corners = np.round(vertices[faces], 6)
    rolled = [min(np.roll(each, k, axis=0).tolist() for k in range(3)) for each in corners]
    return np.array(sorted(rolled))


def binary_stl(vertices: Array, faces: Faces, head: bytes = b"") -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *vertices[each].ravel(), 0) for each in faces]
    return head.ljust(80, b" ") + struct.pack("<I", len(faces)) + b"".join(rows)


def dae(scene: str, *, faces: str = "", unit: str = "", count: int = 12) -> str:
    faces = faces or f"<triangles count='4'>{INPUT}<p>{' '.join(map(str, FACES.ravel()))}</p></triangles>"
    numbers = " ".join(map(str, CORNERS.ravel()))
    return (
        f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"><asset>{unit}<up_axis>Y_UP</up_axis></asset>'
        f"<library_geometries><geometry id='g'><mesh><source id='s'><float_array id='a' count='{count}'>{numbers}"
        "</float_array><technique_common><accessor count='4' source='#a' stride='3'><param name='X'/><param name='Y'/>"
        "<param name='Z'/></accessor></technique_common></source>"
        f"<vertices id='v'><input semantic='POSITION' source='#s'/></vertices>{faces}</mesh></geometry>"
        f"</library_geometries><library_visual_scenes><visual_scene id='scene'>{scene}</visual_scene>"
        "</library_visual_scenes><scene><instance_visual_scene url='#scene'/></scene></COLLADA>"
    )


SINGLE = 4 * float(np.finfo(np.float32).eps)  # of numbers of size 1 after some operations in single precision
INPUT = "<input semantic='VERTEX' source='#v' offset='0'/>"
ONE = "<node><instance_geometry url='#g'/></node>"


def written(folder: Path, name: str, contents: str | bytes) -> Path:
    file = folder / name
    file.write_bytes(contents if isinstance(contents, bytes) else contents.encode())
    return file


@pytest.mark.parametrize("ending", ["stl", "stl_ascii", "obj", "dae"])
def test_files_of_trimesh_are_read(tmp_path: Path, ending: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    mesh.apply_translation([0.1, -0.2, 0.3])
    file = tmp_path / f"mesh.{ending[:3].upper()}"
    file.write_bytes(_bytes(mesh, ending))
    vertices, faces = read_mesh(file)
    np.testing.assert_allclose(surface(vertices, faces), surface(mesh.vertices, mesh.faces), atol=2e-6)


def _bytes(mesh: trimesh.Trimesh, ending: str) -> bytes:
    result = mesh.export(file_type=ending)
    return result if isinstance(result, bytes) else str(result).encode()


def test_all_formats_of_one_body_are_one_mesh(tmp_path: Path) -> None:
    text = ""
    for face in FACES:
        rows = "".join(f"vertex {x} {y} {z}\n" for x, y, z in CORNERS[face])
        text += f"facet normal 0 0 0\nouter loop\n{rows}endloop\nendfacet\n"
    corners = "".join(f"v {x} {y} {z} 1.0\n" for x, y, z in CORNERS)
    indices = "".join(f"f {a + 1}/1/1 {b + 1}//2 {c - 4}\n" for a, b, c in FACES)
    flat = " ".join(map(str, FACES.ravel()))
    polylist = f"<polylist count='4'>{INPUT}<vcount>3 3 3 3</vcount><p>{flat}</p></polylist>"
    polygons = f"<polygons>{INPUT}{''.join(f'<p>{a} {b} {c}</p>' for a, b, c in FACES)}</polygons>"
    normal = "<input semantic='NORMAL' source='#s' offset='1'/>"
    normals = f"<triangles>{normal}{INPUT}<p>{' '.join(f'{i} 3' for i in FACES.ravel())}</p></triangles>"
    files = [
        written(tmp_path, "a.stl", f"solid body\n{text}endsolid\n"),
        written(tmp_path, "b.stl", binary_stl(CORNERS, FACES)),
        written(tmp_path, "c.stl", binary_stl(CORNERS, FACES, b"solid, but binary")),
        written(tmp_path, "d.obj", f"# body\no body\n{corners}vn 0 0 1\n{indices}l 1 2\n"),
        written(tmp_path, "e.dae", dae(ONE)),
        written(tmp_path, "f.DAE", dae(ONE, faces=polylist)),
        written(tmp_path, "g.dae", dae(ONE, faces=polygons)),
        written(tmp_path, "h.dae", dae(ONE, faces=normals)),
    ]
    for file in files:
        np.testing.assert_allclose(surface(*read_mesh(file)), surface(CORNERS, FACES), atol=1e-6, err_msg=file.name)


def test_polygons_become_fans_and_strips_strips(tmp_path: Path) -> None:
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
    vertices, faces = read_mesh(written(tmp_path, "a.obj", square))
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert len(vertices) == 4
    strip = dae(ONE, faces=f"<tristrips>{INPUT}<p>0 1 2 3</p></tristrips>")
    assert read_mesh(written(tmp_path, "b.dae", strip))[1].tolist() == [[0, 1, 2], [2, 1, 3]]
    fan = dae(ONE, faces=f"<trifans>{INPUT}<p>0 1 2 3</p></trifans>")
    assert read_mesh(written(tmp_path, "c.dae", fan))[1].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_a_collada_scene_places_its_meshes_and_knows_its_unit(tmp_path: Path) -> None:
    """T(1, 2, 3) R(z, 90 deg) S(2) of a millimetre file, once by steps and once by a matrix, and borrowed."""
    steps = "<translate>1 2 3</translate><node><rotate>0 0 2 90</rotate><scale>2 2 2</scale>{}</node>"
    matrix = "<matrix>0 -2 0 1  2 0 0 2  0 0 2 3  0 0 0 1</matrix>"
    wanted = 1e-3 * ((CORNERS @ np.array([[0, 2, 0], [-2, 0, 0], [0, 0, 2]])) + [1, 2, 3])
    own = "<instance_geometry url='#g'/>"
    for name, scene in [
        ("a.dae", f"<node>{steps.format(own)}</node>"),
        ("b.dae", f"<node>{matrix}{own}</node>"),
        ("c.dae", f"<node>{matrix}<instance_node url='#lent'/></node><node><node id='lent'>{own}</node></node>"),
    ]:
        vertices, faces = read_mesh(written(tmp_path, name, dae(scene, unit="<unit meter='0.001'/>")))
        np.testing.assert_allclose(vertices[faces[:4]], wanted[FACES], atol=SINGLE, err_msg=name)
    assert len(faces) == 8
    np.testing.assert_allclose(vertices[faces[4:]], 1e-3 * CORNERS[FACES], atol=1e-3 * SINGLE)


def test_parts_side_by_side_keep_their_triangles() -> None:
    """Of different sizes, and one of none."""
    rng = np.random.default_rng(1)
    parts = [
        mesh_files.without_colors(rng.normal(size=(n, 3)), rng.integers(0, max(n, 1), (n, 3))) for n in (3, 0, 5, 2)
    ]
    whole = mesh_files.join_meshes(parts)
    wanted = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    np.testing.assert_array_equal(whole.vertices[whole.faces].reshape(-1, 3), wanted)
    assert whole.faces.min() >= 0
    assert whole.colors.shape == (10, 4)


def test_zero_of_either_sign_is_one_place(tmp_path: Path) -> None:
    signs = np.random.default_rng(2).choice([-1.0, 1.0], (12, 3))
    corners = np.where(CORNERS[FACES.ravel()] == 0, 0.0 * signs, CORNERS[FACES.ravel()])
    file = written(tmp_path, "a.stl", binary_stl(corners, np.arange(12).reshape(4, 3)))
    vertices, faces = read_mesh(file)
    assert len(vertices) == 4
    np.testing.assert_allclose(surface(vertices, faces), surface(CORNERS, FACES), atol=1e-6)


def test_only_vertices_of_triangles_count(tmp_path: Path) -> None:
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    text = "v 9 9 9\n" + corners + "".join(f"f {a + 2} {b + 2} {c + 2}\n" for a, b, c in FACES)
    vertices, faces = read_mesh(written(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(vertices, CORNERS)
    np.testing.assert_array_equal(faces, FACES)


FAR = INPUT.replace("'0'", "'99999999'")
RING = "<node id='n'><instance_node url='#n'/><instance_geometry url='#g'/></node>"
DOUBLING = (
    "".join(
        f"<node id='n{k}'><instance_node url='#n{k + 1}'/><instance_node url='#n{k + 1}'/></node>" for k in range(40)
    )
    + "<node id='n40'><instance_geometry url='#g'/></node>"
)
BROKEN: list[tuple[str, str | bytes, str]] = [
    ("a.stl", b"", "complete binary"),
    ("a.stl", b"\0" * 84, "no triangle"),
    ("a.stl", binary_stl(CORNERS, FACES)[:-1], "complete binary"),
    ("a.stl", b" " * 80 + struct.pack("<I", 2**32 - 1), "4294967295"),
    ("a.stl", binary_stl(np.full((4, 3), np.nan), FACES), "not finite"),
    ("a.stl", "solid\nendsolid\n", "no triangle"),
    ("a.stl", "solid\nvertex 0 0\n", "line 2"),
    ("a.stl", "solid\nvertex 0 0 no\n", "line 2: 'no'"),
    ("a.stl", "solid\nvertex 0 0 0\nendfacet\n", "line 3"),
    ("a.stl", "solid\nvertex 0 0 0\n", "line 2: the file ends"),
    ("a.obj", "v 0 0\n", "line 1"),
    ("a.obj", "v 0 0 x\n", "line 1: 'x'"),
    ("a.obj", "v 0 0 0\nf 1 1\n", "line 2"),
    ("a.obj", "v 0 0 0\nf 1 1 2\n", "vertex 2 of 1"),
    ("a.obj", "v 0 0 0\nf 1 1 0\n", "line 2: '0'"),
    ("a.obj", "v 0 0 0\nf 1 1 -2\n", "line 2: '-2'"),
    ("a.obj", "v 0 0 0\nf 1 1 a/b\n", "line 2: 'a/b'"),
    ("a.obj", "v 0 0 inf\nf 1 1 1\n", "not finite"),
    ("a.obj", b"\xff\xfe\0v", "no triangle"),
    ("a.dae", "<COLLADA", "well-formed"),
    ("a.dae", "<robot/>", "<robot>, not <COLLADA>"),
    ("a.dae", "<COLLADA/>", "no triangle"),
    ("a.dae", "<!DOCTYPE x [<!ENTITY a 'aaaa'>]><COLLADA>&a;</COLLADA>", "entities"),
    ("a.dae", dae("<node><instance_geometry url='#h'/></node>"), "#h not found"),
    ("a.dae", dae(RING), "64 deep"),
    ("a.dae", dae("<node>" * 66 + "<instance_geometry url='#g'/>" + "</node>" * 66), "64 deep"),
    ("a.dae", dae(DOUBLING), "nodes in the scene"),
    ("a.dae", dae("<node><lookat>1 2 3 4 5 6 7 8 9</lookat></node>"), "<lookat>"),
    ("a.dae", dae("<node><matrix>1 2 3</matrix></node>"), "matrix"),
    ("a.dae", dae("<node><translate>1 2 x</translate></node>"), "translate"),
    ("a.dae", dae(ONE, unit="<unit meter='one'/>"), "'one'"),
    ("a.dae", dae(ONE, unit="<unit meter='1e400'/>"), "not finite"),
    ("a.dae", dae(ONE, faces=f"<triangles>{INPUT}<p>0 1 4</p></triangles>"), "beyond the limits"),
    ("a.dae", dae(ONE, faces=f"<triangles>{INPUT}<p>0 1 -1</p></triangles>"), "vertex -1"),
    ("a.dae", dae(ONE, faces=f"<triangles>{INPUT}<p>0 1 0.5</p></triangles>"), "index"),
    ("a.dae", dae(ONE, faces=f"<triangles>{INPUT}<p>0 1</p></triangles>"), "no Collada"),
    ("a.dae", dae(ONE, faces="<triangles><p>0 1 2</p></triangles>"), "no Collada"),
    ("a.dae", dae(ONE, faces=f"<polylist>{INPUT}<vcount>4</vcount><p>0 1 2</p></polylist>"), "<vcount>"),
    ("a.dae", dae(ONE, faces=f"<polylist>{INPUT}<vcount>-1 4</vcount><p>0 1 2</p></polylist>"), "<vcount>"),
    ("a.dae", dae(ONE, faces=f"<lines>{INPUT}<p>0 1</p></lines>"), "no triangle"),
    ("a.dae", dae(ONE, faces=f"<triangles>{FAR}<p>0 1 2</p></triangles>"), "no Collada"),
    ("a.dae", dae(ONE).replace("stride='3'", "stride='4'"), "stride 4"),
    ("a.dae", dae(ONE).replace("stride='3'", "stride='3' offset='1'"), "offset 1"),
    ("a.dae", dae(ONE).replace("0.3", "nan"), "not finite"),
    ("a.dae", dae("<node><rotate>0 0 0 90</rotate></node>"), "no direction"),
    ("a.dae", dae(ONE, faces=f"<triangles>{INPUT}<p>0 1 2</p><p>1 2 3</p></triangles>"), "not supported"),
    ("a.dae", dae(ONE, faces=f"<polygons>{INPUT}<ph><p>0 1 2</p></ph></polygons>"), "not supported"),
    ("a.dae", dae(ONE, faces=f"<polylist>{INPUT}<vcount>2000000000</vcount><p>0 1 2</p></polylist>"), "<vcount>"),
    ("a.dae", dae("<node><instance_controller url='#g'/></node>"), "#g not found"),
    ("a.dae", b"PK\3\4" + bytes(30), "well-formed"),
    ("a.ply", "ply", "'.ply'|endings"),
    ("a", "", "endings"),
]


@pytest.mark.parametrize(("name", "contents", "message"), BROKEN, ids=range(len(BROKEN)))
def test_a_broken_file_is_named_with_the_place(tmp_path: Path, name: str, contents: str | bytes, message: str) -> None:
    file = written(tmp_path, name, contents)
    with pytest.raises(ModelError, match=message) as caught:
        read_mesh(file)
    assert str(file) in str(caught.value)
    assert caught.value.name == str(file)


def test_a_large_file_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = replace(INPUT_LIMITS, mesh_bytes=1000, mesh_text_bytes=100)
    monkeypatch.setattr(mesh_files, "INPUT_LIMITS", limits)
    for name, contents in [("a.stl", b"solid" + b" " * 200), ("a.obj", b" " * 101), ("a.dae", b" " * 101)]:
        with pytest.raises(ModelError, match=r"bytes of text, limit 100|at most 100 are read"):
            read_mesh(written(tmp_path, name, contents))
    file = written(tmp_path, "b.stl", b" " * 1001)
    monkeypatch.setattr(os, "open", lambda *_: pytest.fail("opened"))
    with pytest.raises(ModelError, match="1001 bytes, at most 1000 are read"):
        read_mesh(file)


def test_too_many_triangles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_files, "INPUT_LIMITS", replace(INPUT_LIMITS, mesh_triangles=3))
    corner = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\n"
    broken: list[tuple[str, str | bytes]] = [
        ("a.stl", binary_stl(CORNERS, FACES)),
        ("b.stl", "solid\n" + 4 * corner),
        ("c.obj", "v 0 0 0\n" + 4 * "f 1 1 1\n"),
        ("d.dae", dae(ONE)),
    ]
    for name, contents in broken:
        with pytest.raises(ModelError) as caught:
            read_mesh(written(tmp_path, name, contents))
        assert caught.value.limit == 3


@pytest.mark.parametrize("path", ["absent.stl", "nul\0.stl", 3, None, ".stl"])
def test_invalid_files_are_refused(path: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match="mesh"):
        read_mesh(path)  # type: ignore[arg-type]
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(ModelError, match="cannot be read"):
        read_mesh(tmp_path / "folder.stl")


def test_without_its_reader_a_collada_file_is_refused_with_the_package_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "collada", None)
    with pytest.raises(ModelError, match=r'"selfmotion\[meshes\]", or from a clone pip install "\.\[meshes\]"'):
        read_mesh(written(tmp_path, "a.dae", dae(ONE)))
    assert len(read_mesh(written(tmp_path, "a.stl", binary_stl(CORNERS, FACES)))[1]) == 4


def test_an_obj_file_opens_no_picture_and_no_pipe(tmp_path: Path) -> None:
    """Of what stands beside it the library of materials alone is read, and that where it is a regular file."""
    os.mkfifo(tmp_path / "pipe.mtl")
    body = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    assert np.isnan(read_painted_mesh(written(tmp_path, "a.obj", f"mtllib pipe.mtl\n{body}")).colors).all()
    os.mkfifo(tmp_path / "picture.png")
    written(tmp_path, "b.mtl", "newmtl red\nmap_Kd picture.png\nKd 1 0 0\n")
    colors = read_painted_mesh(written(tmp_path, "b.obj", f"mtllib b.mtl\nusemtl red\n{body}")).colors
    assert colors.tolist() == [[1, 0, 0, 1]]


@pytest.mark.parametrize("seed", range(8))
def test_mutated_files_are_read_or_refused_with_an_error_of_the_package(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(f"f {a} {b} {c}\n" for a, b, c in FACES + 1)
    text = "solid\n" + "".join(
        "facet\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in CORNERS[face]) + "endfacet\n" for face in FACES
    )
    sound: dict[str, str | bytes] = {
        "a.stl": binary_stl(CORNERS, FACES),
        "b.stl": f"{text}endsolid\n",
        "c.obj": body,
        "d.dae": dae(ONE),
    }
    for name, contents in sound.items():
        data = contents if isinstance(contents, bytes) else contents.encode()
        for _ in range(30):
            changed = bytearray(data)
            for place in rng.integers(len(data), size=rng.integers(1, 4)):
                changed[place : place + int(rng.integers(0, 3))] = rng.bytes(int(rng.integers(0, 3)))
            with suppress(ModelError):
                vertices, faces = read_mesh(written(tmp_path, name, bytes(changed)))
                assert np.isfinite(vertices).all()
                assert faces.max() < len(vertices)


def test_names_are_found_where_ros_finds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "share" / "arm description"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    file = written(package / "meshes", "upper arm.stl", binary_stl(CORNERS, FACES))
    name = "package://arm%20description/meshes/upper%20arm.stl".replace("arm%20description", "arm description")
    assert find_mesh(name, package / "urdf") == file
    assert find_mesh(name, None, [tmp_path / "share"]) == file
    assert find_mesh(name, None, [str(package)]) == file
    assert find_mesh(name, None) is None
    assert find_mesh("model://arm description/meshes/upper arm.stl", package) == file
    assert find_mesh(file.as_uri(), None) == file
    assert find_mesh(str(file), None) == file
    assert find_mesh(str(file), tmp_path) == file
    assert find_mesh("meshes/upper arm.stl", package) == file
    assert find_mesh("../meshes/upper arm.stl", package / "urdf").samefile(file)  # type: ignore[union-attr]
    monkeypatch.chdir(package)
    assert find_mesh("meshes/upper arm.stl", None) == Path("meshes/upper arm.stl")
    assert find_mesh("meshes", None) is None
    assert find_mesh("a\0b", tmp_path) is None
    assert find_mesh("x" * 5000, tmp_path) is None


def test_of_packages_in_packages_that_of_the_description_is_taken(tmp_path: Path) -> None:
    """Folders told before all others, and of the same names within each other the nearest above the description."""
    mesh = binary_stl(CORNERS, FACES)
    names = ("arm", "arm/arm", "arm/arm/arm", "told", "hall/arm")
    files = [written_in(tmp_path / name / "meshes", mesh) for name in names]
    described = tmp_path / "arm" / "arm" / "urdf"
    name = "package://arm/meshes/a.stl"
    assert find_mesh(name, described) == files[1]
    assert find_mesh(name, tmp_path / "arm" / "urdf") == files[0]
    assert find_mesh(name, described, [tmp_path / "told"]) == files[3]
    assert find_mesh(name, described, [tmp_path / "hall"]) == files[4]
    assert find_mesh(name, described, [tmp_path / "arm"]) == files[0]
    files[0].unlink()
    assert find_mesh(name, described, [tmp_path / "arm"]) == files[1]


def written_in(folder: Path, contents: bytes) -> Path:
    folder.mkdir(parents=True)
    return written(folder, "a.stl", contents)


def test_packages_are_found_where_they_are_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As ROS names them, and as pip installs those of example-robot-data; folders that are told come first."""
    name, places = "package://some_arm/a.stl", ("site/cmeel.prefix/share", "ament/share", "ros", "told")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "site")])
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join([str(tmp_path / "none"), str(tmp_path / "ament")]))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ros"))
    assert find_mesh(name, tmp_path, [tmp_path / "told"]) is None
    for place in places:  # each goes before those before it
        (tmp_path / place / "some_arm").mkdir(parents=True)
        file = written(tmp_path / place / "some_arm", "a.stl", binary_stl(CORNERS, FACES))
        assert find_mesh(name, tmp_path, [tmp_path / "told"]) == file


def test_faces_have_the_colour_of_their_material(tmp_path: Path) -> None:
    """Collada: by the instance's names of them; OBJ: from the library beside it. What has none is not a number."""
    sets = "".join(
        f"<triangles count='1' material='{m}'>{INPUT}<p>0 1 2</p></triangles>" for m in ("one", "two", "three")
    )
    effects = "".join(
        f"<effect id='e{k}'><profile_COMMON><technique sid='t'><phong><diffuse><color>{color}</color></diffuse></phong>"
        f"</technique></profile_COMMON></effect>"
        for k, color in enumerate(("1 0 0 1", "0 0.5 1 0.3"))
    )
    materials = "".join(f"<material id='m{k}'><instance_effect url='#e{k}'/></material>" for k in range(2))
    bound = "<bind_material><technique_common><instance_material symbol='one' target='#m1'/><instance_material "
    bound += "symbol='two' target='#m0'/></technique_common></bind_material>"
    scene = f"<node><instance_geometry url='#g'>{bound}</instance_geometry></node>"
    text = dae(scene, faces=sets).replace("<asset>", f"<library_effects>{effects}</library_effects>{materials}<asset>")
    colors = read_painted_mesh(written(tmp_path, "a.dae", text)).colors
    np.testing.assert_allclose(colors, np.array([[0, 0.5, 1, 1], [1, 0, 0, 1], [np.nan] * 4]))
    written(tmp_path, "b.mtl", "newmtl blue\nKd 0 0 1\nnewmtl wrong\nKd a b c\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nmtllib b.mtl\nmtllib none.mtl\nf 1 2 3\n"
    corners += "usemtl blue\nf 1 2 3\nusemtl wrong\nf 1 2 3\n"
    colors = read_painted_mesh(written(tmp_path, "b.obj", corners)).colors
    np.testing.assert_allclose(colors, np.array([[np.nan] * 4, [0, 0, 1, 1], [np.nan] * 4]))
    assert np.isnan(read_painted_mesh(written(tmp_path, "c.stl", binary_stl(CORNERS, FACES))).colors).all()


def test_folders_that_are_none_are_refused() -> None:
    with pytest.raises(ModelError, match="folders"):
        find_mesh("a.stl", None, [3])  # type: ignore[list-item]
    with pytest.raises(ModelError, match="file"):
        find_mesh(3, None)  # type: ignore[arg-type]


@pytest.mark.parametrize("robot", ["tiago_description", "kinova_description", "ur_description", "so_arm_description"])
def test_meshes_of_real_robots_have_the_size_that_coal_reads(robot: str) -> None:
    coal = pytest.importorskip("coal")
    root = next(path.parents[2] for path in collection() if path.parents[2].name == "robots")
    files = sorted(file for file in (root / robot).rglob("*") if file.suffix.lower() in mesh_files.READERS)
    for file in files[::3]:
        vertices, _ = read_mesh(file)
        other = np.array(coal.MeshLoader().load(str(file)).vertices())
        np.testing.assert_allclose(vertices.min(axis=0), other.min(axis=0), atol=1e-6, err_msg=str(file))
        np.testing.assert_allclose(vertices.max(axis=0), other.max(axis=0), atol=1e-6, err_msg=str(file))


KINDS_OF_ROWS, SHAPES_OF_ROWS = st.sampled_from([float, np.int64]), st.tuples(st.integers(0, 30), st.integers(1, 4))


@given(hnp.arrays(KINDS_OF_ROWS, SHAPES_OF_ROWS, elements=st.integers(-2, 2)))
def test_distinct_rows_are_those_of_numpy(rows: Any) -> None:
    first, which = distinct_rows(rows)
    expected, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(rows[first], expected)
    np.testing.assert_array_equal(first, index)
    np.testing.assert_array_equal(which, inverse.ravel())
