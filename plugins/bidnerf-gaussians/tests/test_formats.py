"""Files of Gaussians: what is written is read again, known bytes have known values, and what is damaged is told."""

from __future__ import annotations

import gzip
import io
import json
import math
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image

from bidnerf_core.errors import InputError
from bidnerf_core.io import read_ply
from bidnerf_core.maps import UNMOVED
from bidnerf_gaussians import Gaussians, read_gaussians, write_gaussians
from bidnerf_gaussians.formats import format_of, spz
from bidnerf_gaussians.gaussians import cleaned
from bidnerf_gaussians.importer import GaussiansImporter, ImportSettings
from bidnerf_gaussians.quaternions import matrices

Some = Callable[..., Gaussians]
C0 = 0.28209479177387814


def differences(a: Gaussians, b: Gaussians) -> dict[str, float]:
    """Return the largest differences of the parameters; of rotations that of their matrices."""
    found = {
        name: float((getattr(a, name) - getattr(b, name)).abs().max())
        for name in ("means", "log_scales", "logits", "harmonics")
    }
    return found | {"rotation": float((rotations(a) - rotations(b)).abs().max())}


def rotations(g: Gaussians) -> torch.Tensor:
    return matrices(torch.nn.functional.normalize(g.quaternions, dim=-1))


def test_a_written_ply_is_read_again(tmp_path: Path, some: Some) -> None:
    for degree in range(4):
        path = tmp_path / f"{degree}.ply"
        write_gaussians(path, some(20, degree))
        assert max(differences(read_gaussians(path), some(20, degree)).values()) < 1e-6


def test_a_written_spz_is_read_again_to_within_its_bytes(tmp_path: Path, some: Some) -> None:
    for degree in range(4):
        path = tmp_path / f"{degree}.spz"
        g = some(200, degree)
        g.harmonics.clamp_(-0.98, 0.98)  # the range of a byte
        write_gaussians(path, g)
        found = differences(read_gaussians(path), g)
        assert found["means"] < 1e-5
        assert found["log_scales"] < 0.04
        assert found["rotation"] < 0.01
        assert found["harmonics"] < 0.02
        assert found["logits"] < 0.05


def test_discs_of_2d_gaussian_splatting_are_thin_gaussians(tmp_path: Path, some: Some) -> None:
    gaussians, path = some(40), tmp_path / "discs.ply"
    columns = torch.cat(
        [
            gaussians.means,
            gaussians.harmonics[:, 0],
            gaussians.logits[:, None],
            gaussians.log_scales[:, :2],
            gaussians.quaternions,
        ],
        dim=-1,
    )
    body = columns.numpy().astype("<f4").tobytes()
    path.write_bytes(inria(40, body=body).replace(b"property float scale_2\n", b""))
    thin = gaussians.log_scales.clone()
    thin[:, 2] = thin[:, :2].amin(-1) + math.log(1e-3)
    expected = replace(gaussians, log_scales=thin, harmonics=gaussians.harmonics[:, :1])
    assert max(differences(read_gaussians(path), expected).values()) < 1e-5
    assert "2D Gaussian Splatting" in GaussiansImporter().read(path, ImportSettings(), UNMOVED).found[0]


def test_plys_of_mip_splatting_and_cloudcompare_are_those_of_splats(tmp_path: Path, some: Some) -> None:
    """A 3D filter convolves each splat with a Gaussian and keeps its integral; CloudCompare renames what it keeps."""
    write_gaussians(tmp_path / "plain.ply", plain := some(20))
    rows = read_ply(tmp_path / "plain.ply", "a PLY")["vertex"]
    names = rows.dtype.names or ()

    def write(name: str, values: dict[str, np.ndarray]) -> Path:
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        body = np.stack([column.astype("<f4") for column in values.values()], axis=1).tobytes()
        head = "\n".join([*lines, *(f"property float {key}" for key in values), "end_header", ""]).encode()
        (tmp_path / name).write_bytes(head + body)
        return tmp_path / name

    columns = {name: rows[name] for name in names}
    renamed = read_gaussians(write("cc.ply", {k if k in "xyz" else f"scalar_{k}": v for k, v in columns.items()}))
    assert torch.equal(renamed.log_scales, read_gaussians(tmp_path / "plain.ply").log_scales)
    filtered = read_gaussians(write("mip.ply", columns | {"filter_3D": np.full(len(rows), 0.05)}))
    assert torch.allclose(filtered.log_scales.exp() ** 2, plain.log_scales.exp() ** 2 + 0.05**2, rtol=1e-4)
    integral = [g.opacities * g.log_scales.sum(-1).exp() for g in (filtered, plain)]
    assert torch.allclose(*integral, rtol=1e-3)
    with pytest.raises(InputError, match="has motion_0: its splats move"):
        read_gaussians(write("moving.ply", columns | {"motion_0": np.zeros(len(rows))}))


def test_an_spz_has_other_axes_than_a_ply(tmp_path: Path, some: Some) -> None:
    """In the file y is up and z is back; here they are as in a PLY."""
    path = tmp_path / "one.spz"
    gaussians = replace(some(1, 0), means=torch.tensor([[1.0, 2.0, 3.0]]))
    write_gaussians(path, gaussians)
    raw = gzip.decompress(path.read_bytes())
    bits = raw[13]
    fixed = [int.from_bytes(raw[16 + 3 * i : 19 + 3 * i], "little", signed=True) / 2**bits for i in range(3)]
    assert fixed == pytest.approx([1, -2, -3], abs=1e-4)


def spz_content(version: int, count: int = 2, degree: int = 0) -> list[bytes]:
    """Return the sections of a file: positions (1, -2, -3), opacity 0.5, grey, scales exp(-2), no rotation."""
    if version == 1:
        position = np.tile(np.array([1, -2, -3], "<f2"), count).tobytes()
    else:
        position = b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1, -2, -3)) * count
    identity = bytes([128, 128, 128]) if version < 3 else struct.pack("<I", 3 << 30)
    harmonics = bytes([128]) * (3 * ((degree + 1) ** 2 - 1) * count)
    return [
        position,
        bytes([128]) * count,
        bytes([128]) * 3 * count,
        bytes([128]) * 3 * count,
        identity * count,
        harmonics,
    ]


def spz4(sections: list[bytes], degree: int, stored: list[bytes] | None = None) -> bytes:
    """Return a file of version 4 that declares the sections of two Gaussians; ``stored`` are others in their place."""
    packed = [zstandard.ZstdCompressor().compress(part) for part in stored or sections]
    sizes = b"".join(struct.pack("<QQ", len(a), len(b)) for a, b in zip(packed, sections, strict=True))
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 2, degree, 12, 0, len(sections), 32)
    return header + sizes + b"".join(packed)


def test_all_versions_of_spz(tmp_path: Path) -> None:
    for version in (1, 2, 3, 4):
        sections, path = spz_content(version, degree=1), tmp_path / f"{version}.spz"
        if version < 4:
            header = struct.pack("<4sIIBBBB", b"NGSP", version, 2, 1, 12, 0, 0)
            path.write_bytes(gzip.compress(header + b"".join(sections)))
        else:
            path.write_bytes(spz4(sections, degree=1))
        found = read_gaussians(path)
        assert found.means.tolist() == [[1, 2, 3]] * 2, version
        assert torch.allclose(found.log_scales, torch.tensor(-2.0))
        assert found.degree == 1
        assert float(found.opacities[0]) == pytest.approx(0.5, abs=0.01)
        assert torch.allclose(rotations(found).abs(), torch.eye(3), atol=0.02), version


def test_known_bytes_of_a_splat_file(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 128, 128, 255, 128, 128, 128))
    found = read_gaussians(path)
    assert found.means.tolist() == [[1, 2, 3]]
    assert torch.allclose(found.log_scales.exp(), torch.tensor([[0.1, 0.2, 0.3]]))
    assert torch.allclose(0.5 + C0 * found.harmonics[0, 0], torch.tensor([1.0, 0, 128 / 255]), atol=1e-6)
    assert found.quaternions[0, 0] > 0.9
    assert float(found.quaternions[0, 1:].abs().max()) == 0


def compressed_ply(counts: tuple[int, int] = (1, 2)) -> bytes:
    """Return a compressed file of one chunk from -1 to 1, with one Gaussian in a corner and one in the middle."""
    ranges = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
    order = [
        f"{end}_{name}" for part in (ranges[:3], ranges[3:6], ranges[6:]) for end in ("min", "max") for name in part
    ]
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {counts[0]}"]
    header += [f"property float {name}" for name in order] + [f"element vertex {counts[1]}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    limits = {"x": (-1, 1), "y": (-1, 1), "z": (-1, 1), "r": (0, 1), "g": (0, 1), "b": (0, 1)}
    chunk = [limits.get(n.split("_", 1)[1], (-4, -2))[n.startswith("max")] for n in order]
    middle = 512 << 20 | 512 << 10 | 512
    rows = (
        (2**32 - 1, middle, 0, 0xFF0000FF),
        (1024 << 21 | 512 << 11 | 1024, middle, 2**32 - 1, 0x80808080),
    )
    body = struct.pack("<18f", *chunk) + b"".join(struct.pack("<4I", *row) for row in rows)
    return "\n".join([*header, "end_header", ""]).encode() + body


def test_known_bits_of_a_compressed_ply(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(compressed_ply())
    found = read_gaussians(path)
    assert torch.allclose(found.means, torch.tensor([[1.0, 1, 1], [0, 0, 0]]), atol=1e-3)
    assert torch.allclose(found.log_scales, torch.tensor([[-4.0] * 3, [-2] * 3]))
    assert torch.allclose(0.5 + C0 * found.harmonics[0, 0], torch.tensor([1.0, 0, 0]), atol=1e-6)
    assert float(found.opacities[0]) > 0.999
    assert float(found.quaternions[0, 0]) > 0.999


def sog_parts(count: int = 3) -> dict[str, bytes]:
    """Return the members of a SOG archive of ``count`` equal Gaussians in an image of 2 x 2."""

    def image(*pixel: int, size: tuple[int, int] = (2, 2)) -> bytes:
        content = io.BytesIO()
        Image.new("RGBA", size, pixel).save(content, "WEBP", lossless=True, exact=True)
        return content.getvalue()

    book = np.linspace(-4, 4, 256).tolist()
    files = {
        "means": ["means_l.webp", "means_u.webp"],
        "quats": ["quats.webp"],
        "scales": ["scales.webp"],
        "sh0": ["sh0.webp"],
        "shN": ["centroids.webp", "labels.webp"],
    }
    meta = {name: {"files": names, "codebook": book} for name, names in files.items()}
    meta["means"] |= {"mins": [-1, -1, -1], "maxs": [1, 1, 1]}
    meta["shN"] |= {"bands": 1, "count": 64}
    return {
        "meta.json": json.dumps({"version": 2, "count": count} | meta).encode(),
        "means_l.webp": image(255, 0, 255, 255),
        "means_u.webp": image(255, 0, 127, 255),
        "quats.webp": image(128, 128, 128, 252),
        "scales.webp": image(0, 255, 0, 255),
        "sh0.webp": image(255, 0, 255, 128),
        "centroids.webp": image(255, 0, 0, 255, size=(64 * 3, 1)),
        "labels.webp": image(5, 0, 0, 255),
    }


def write_sog(path: Path, parts: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


def test_known_bytes_of_a_sog_archive_and_folder(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, content in sog_parts().items():
        (folder / name).write_bytes(content)
    for path in (write_sog(tmp_path / "a.sog", sog_parts()), folder, folder / "meta.json"):
        found = read_gaussians(path)
        assert len(found) == 3
        assert found.degree == 1
        e = np.e - 1
        assert found.means[0].tolist() == pytest.approx([e, -e, 0], abs=1e-2)
        assert found.log_scales[0].tolist() == [-4, 4, -4]
        assert found.harmonics[0].tolist() == [[4, -4, 4]] + [[4, -4, -4]] * 3
        assert float(found.quaternions[0, 0]) > 0.99


def glb(g: Gaussians, nodes: Sequence[dict[str, object]] = ({"mesh": 0},)) -> bytes:
    """Return a file of one mesh of Gaussians, by default in one node."""
    names = ["POSITION", *(f"KHR_gaussian_splatting:{n}" for n in ("SCALE", "ROTATION", "OPACITY"))]
    names += [f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{n}" for d in range(g.degree + 1) for n in range(2 * d + 1)]
    columns = [g.means, g.log_scales, g.quaternions.roll(-1, 1), g.opacities[:, None], *g.harmonics.unbind(1)]
    body, views, accessors = b"", [], []
    for number, column in enumerate(columns):
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": 4 * column.numel()})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]]
        accessors.append({"bufferView": number, "componentType": 5126, "count": len(column), "type": kind})
        body += column.numpy().astype("<f4").tobytes()
    primitive = {
        "attributes": {name: number for number, name in enumerate(names)},
        "mode": 0,
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    gltf = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": nodes,
    }
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def test_nodes_of_a_gltf_take_time_and_memory_in_proportion_to_the_file(
    tmp_path: Path, some: Some, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, count = tmp_path / "a.glb", 20_000
    chain: list[dict[str, object]] = [{"children": [number + 1], "translation": [1, 0, 0]} for number in range(count)]
    path.write_bytes(glb(some(3), [*chain, {"mesh": 0}]))
    shift = torch.tensor([float(count), 0, 0])
    torch.testing.assert_close(read_gaussians(path).means, some(3).means + shift)
    path.write_bytes(glb(some(3), [*chain, {"mesh": 0, "children": [0]}]))
    with pytest.raises(InputError, match="its nodes are children of themselves"):
        read_gaussians(path)
    path.write_bytes(glb(some(3), [{"mesh": 0}] * 16))
    assert len(read_gaussians(path)) == 48
    monkeypatch.setattr("bidnerf_core.io.allowance.FREE", 0)
    monkeypatch.setattr("bidnerf_core.io.allowance.TIMES", 1)
    with pytest.raises(InputError, match="unpacks to"):
        read_gaussians(path)


def test_gltf(tmp_path: Path, some: Some) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(glb(some(10, 2)))
    assert max(differences(read_gaussians(path), some(10, 2)).values()) < 1e-5
    half = np.sqrt(0.5)
    node = {"mesh": 0, "scale": [2, 2, 2], "rotation": [half, 0, 0, half], "translation": [1, 0, 0]}
    path.write_bytes(glb(some(10, 1), [node]))
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    expected = some(10, 1).similar(2.0, turn, torch.tensor([1.0, 0, 0]))
    assert max(differences(read_gaussians(path), expected).values()) < 1e-5
    changes: tuple[tuple[dict[str, object], str], ...] = (
        ({"scale": [1, 2, 1]}, "stretches or mirrors"),
        ({"scale": [-1, 1, 1]}, "stretches or mirrors"),
        ({"rotation": [0, 0, 0, 0]}, r"a\.glb: is damaged .*zero norm"),
        ({"rotation": [0, 0, 1]}, r"a\.glb: is damaged"),
        ({"translation": [1, 0]}, r"a\.glb: is damaged"),
    )
    for change, message in changes:
        path.write_bytes(glb(some(3), [{"mesh": 0} | change]))
        with pytest.raises(InputError, match=message):
            read_gaussians(path)
    whole = glb(some(3))
    for damaged, message in (
        (whole.replace(b'"count": 3', b'"count": 9'), "is too short|is damaged"),
        (whole.replace(b'"buffers"', b'"bufferz"'), "is too short|is damaged"),
        (whole.replace(b'"VEC4"', b'"VEC9"'), "is too short|is damaged"),
        (whole.replace(b'"count": 3', b'"count": 2', 1), "one for each Gaussian"),
        (whole[:-20], "is truncated"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=message):
            read_gaussians(path)


def test_checkpoints_of_gsplat_and_splatfacto(tmp_path: Path, some: Some) -> None:
    g = some(10, 2)
    names = {"means": g.means, "scales": g.log_scales, "quats": g.quaternions}
    gsplat = names | {"opacities": g.logits, "sh0": g.harmonics[:, :1], "shN": g.harmonics[:, 1:]}
    splatfacto = names | {
        "opacities": g.logits[:, None],
        "features_dc": g.harmonics[:, 0],
        "features_rest": g.harmonics[:, 1:],
    }
    pipeline = {f"_model.gauss_params.{name}": value for name, value in splatfacto.items()}
    torch.save({"step": 1, "splats": gsplat}, tmp_path / "a.pt")
    torch.save({"pipeline": pipeline | {"_model.lpips.weight": torch.zeros(2)}}, tmp_path / "b.ckpt")
    for name in ("a.pt", "b.ckpt"):
        assert max(differences(read_gaussians(tmp_path / name), g).values()) == 0
    repeated = {name: value[:1].expand(10**9, *value.shape[1:]) for name, value in gsplat.items()}
    for broken, message in (
        ({"sh0": torch.zeros(7)}, "different counts"),
        ({"means": torch.tensor(1.0)}, "different counts"),
        (repeated, "unpacks to"),
    ):
        torch.save({"splats": gsplat | broken}, tmp_path / "a.pt")
        with pytest.raises(InputError, match=message):
            read_gaussians(tmp_path / "a.pt")


def test_checkpoints_of_other_fields_are_not_recognised(tmp_path: Path) -> None:
    torch.save({"model_coarse_state_dict": {"layer1.weight": torch.zeros(2)}}, tmp_path / "a.ckpt")
    assert format_of(tmp_path / "a.ckpt") is None


def test_a_pickle_is_not_executed(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, (f"touch {tmp_path}/executed",)

    torch.save({"splats": {"means": Trap()}}, tmp_path / "a.pt")
    (tmp_path / "b.pt").write_bytes(pickle.dumps(Trap()))
    for name in ("a.pt", "b.pt"):
        with pytest.raises(InputError):
            read_gaussians(tmp_path / name)
    assert not (tmp_path / "executed").exists()


def test_gaussians_that_cannot_be_rendered_are_dropped_and_counted(some: Some) -> None:
    g = some(8)
    g.means[0, 1] = torch.nan
    g.log_scales[1, 0] = torch.inf
    g.quaternions[2] = 0
    g.logits[3] = -30
    g.logits[4] = torch.inf  # an opacity of 1
    g.log_scales[5] = -torch.inf
    kept, dropped = cleaned(g, "x")
    assert len(kept) == 3
    assert bool(kept.logits.isfinite().all())
    counts = "3 with numbers that are not finite or too large, 1 with a zero quaternion, 1 that are transparent"
    assert dropped == counts
    with pytest.raises(InputError, match="none of its 1 Gaussians"):
        cleaned(g[:1], "x")
    with pytest.raises(InputError, match="spherical harmonics"):
        cleaned(replace(g, harmonics=torch.zeros(8, 5, 3)), "x")


def inria(count: int, rest: int = 0, body: bytes = b"") -> bytes:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {n}" for n in names), "end_header", ""]).encode() + body


def test_bad_files_are_told_before_memory_is_taken(tmp_path: Path, some: Some) -> None:
    write_gaussians(tmp_path / "good.spz", some(30))
    good = (tmp_path / "good.spz").read_bytes()
    unpacked = gzip.decompress(good)
    parts = sog_parts()
    no_image = parts | {"quats.webp": b"not a readable image"}
    huge = json.loads(parts["meta.json"]) | {"count": 10**12}
    cases: dict[str, tuple[bytes, str]] = {
        "huge.ply": (inria(10**12), "too few"),
        "lists.ply": (inria(1).replace(b"property float x", b"property list uchar int l\nproperty float x"), "too few"),
        "bare.ply": (
            inria(1).replace(b"element vertex", b"element bare 1000000000000\nelement vertex"),
            "not a readable file of Gaussians",
        ),
        "cut.ply": (inria(3, body=bytes(100)), "too few"),
        "degree.ply": (inria(1, 10, bytes(24 * 4)), "properties f_rest_N"),
        "chunks.ply": (compressed_ply((0, 2)), "too few chunks"),
        "odd.splat": (bytes(33), "multiple of 32"),
        "empty.splat": (b"", "multiple of 32"),
        "cut.spz": (good[: len(good) // 2], "data ends after"),
        "huge.spz": (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**32 - 1, 3, 12, 0, 0)), "unpacks to"),
        "short.spz": (gzip.compress(unpacked[:-10]), "data ends after"),
        "degree.spz": (gzip.compress(unpacked[:12] + b"\x07" + unpacked[13:]), "degree 7"),
        "version.spz": (gzip.compress(unpacked[:4] + b"\x09" + unpacked[5:]), "version 9"),
        "huge4.spz": (struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10**3, 0, 12, 0, 5, 32) + bytes(80), "is it truncated"),
        "dense4.spz": (struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10**9, 0, 12, 0, 5, 32) + bytes(80), "unpacks to"),
        "none.sog": (b"no archive", "not a zip archive"),
        "text.pt": (b"no checkpoint", "not a readable file of Gaussians"),
        "mesh.ply": (
            b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
            "not a readable file of Gaussians",
        ),
    }
    archive = bytearray(write_sog(tmp_path / "a.sog", parts).read_bytes())
    archive[6] |= 1  # "encrypted", in both headers of the first member
    archive[archive.index(b"PK\x01\x02") + 8] |= 1
    cases["encrypted.sog"] = bytes(archive), "cannot be unpacked"
    for name, content in (
        ("noimage.sog", no_image),
        ("huge.sog", parts | {"meta.json": json.dumps(huge).encode()}),
    ):
        write_sog(tmp_path / name, content)
        cases[name] = (
            (tmp_path / name).read_bytes(),
            "not a readable image" if name[0] == "n" else "declares 1000000000000",
        )
    for name, (content, message) in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=message) as failure:
            read_gaussians(path)
        assert str(path) in str(failure.value)
        assert "\n" not in str(failure.value)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_sog(tmp_path / "bomb.sog", sog_parts() | {"quats.webp": bytes(3000)})
    monkeypatch.setattr("bidnerf_core.io.allowance.FREE", 2000)
    monkeypatch.setattr("bidnerf_core.io.allowance.TIMES", 0)
    with pytest.raises(InputError, match="unpacks to"):
        read_gaussians(path)
    sections = spz_content(4)[:5]
    (tmp_path / "bomb.spz").write_bytes(spz4(sections, 0, [bytes(10**7), *sections[1:]]))
    with pytest.raises(InputError, match="a stream unpacks to 10,000,000 bytes"):
        read_gaussians(tmp_path / "bomb.spz")
    stream = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2, 0, 12, 0, 0) + bytes(10**7))
    (tmp_path / "bomb.spz").write_bytes(stream)
    assert len(read_gaussians(tmp_path / "bomb.spz")) == 2  # what is behind the declared Gaussians is left packed


def test_other_endings_are_not_written(tmp_path: Path, some: Some) -> None:
    with pytest.raises(InputError, match="cannot write"):
        write_gaussians(tmp_path / "a.splat", some())
    far = replace(some(1), means=torch.full((1, 3), 1e8))
    with pytest.raises(InputError, match="too far"):
        spz.write(tmp_path / "a.spz", far)


DATA = os.environ.get("BIDNERF_DATA")


@pytest.mark.skipif(DATA is None, reason="needs BIDNERF_DATA")
def test_files_of_others_hold_the_same_scene() -> None:
    """A compressed PLY and an .spz of one scene, each converted by others, agree to within their precision."""
    folder = Path(DATA or "") / "gaussian_splats"
    a, b = (read_gaussians(folder / f"biker.{ending}") for ending in ("compressed.ply", "spz"))
    assert format_of(folder / "biker.spz") is not None
    assert len(a) == len(b) == 152_746
    assert float((a.means - b.means).abs().max()) < 2e-3
    assert float((a.log_scales - b.log_scales).abs().median()) < 0.05
    assert float((a.opacities - b.opacities).abs().max()) < 0.01
    first, second = ((rotations(g) * g.log_scales.exp().square()[:, None]) @ rotations(g).mT for g in (a, b))
    off = (first - second).flatten(1).norm(dim=1) / first.flatten(1).norm(dim=1)
    assert float(off.median()) < 0.1
