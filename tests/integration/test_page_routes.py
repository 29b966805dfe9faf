"""What serves the page, and the routes that it needs: planes before a reconstruction, and two results compared."""

import re

import httpx
import numpy as np
import pytest

from model.geometry import Grid
from service.routes.page import POLICY
from tests.service_parts import (
    NAME,
    app_for,
    behind_prefix,
    mask_bytes,
    mask_parts,
    nifti_of,
    running,
    sparse_ellipsoid,
)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("page"))) as opened:
        yield opened


def assets(page: str) -> list[str]:
    return re.findall(r'(?:src|href)="(\./page/[^"]+)"', page)


def test_the_page_and_all_that_it_names_come_from_relative_addresses(client):
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    found = assets(page.text)
    assert {name.rsplit(".", 1)[1] for name in found} == {"js", "css", "svg"}
    assert not re.search(r'(?:src|href)="(?!\./page/)', page.text)
    for name in found:
        assert client.get(name).status_code == 200


def test_its_policy_lets_nothing_in_from_elsewhere_and_nothing_inline(client):
    page = client.get("/")
    for answer in (page, *(client.get(name) for name in assets(page.text))):
        assert answer.headers["content-security-policy"] == POLICY
    assert "unsafe" not in POLICY
    assert "http" not in POLICY
    assert not re.search(r"<script(?![^>]*src=)|<style|style=|onclick=", page.text)


def test_scripts_travel_compressed_and_are_kept_by_their_digest(client):
    script = next(name for name in assets(client.get("/").text) if name.endswith(".js"))
    packed = client.get(script)
    assert packed.headers["content-encoding"] == "gzip"
    assert "immutable" in packed.headers["cache-control"]
    plain = client.get(script, headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    assert plain.content == packed.content
    assert int(packed.headers["content-length"]) < 1_200_000
    assert client.get("/").headers["cache-control"] == "no-cache"


@pytest.mark.parametrize("name", ["nothing.js", "..%2Findex.html", "%2e%2e/app.py", ".", "a%00b", "licences"])
def test_nothing_else_is_served(client, name):
    assert client.get(f"/page/{name}").status_code in (404, 422)


def test_the_page_is_no_part_of_the_interfaces_description(client):
    assert not {"/", "/page/{name}"} & set(client.get("/openapi.json").json()["paths"])


def test_the_page_is_open_where_everything_else_asks_for_a_key(tmp_path):
    with running(app_for(tmp_path, api_keys=("k",))) as client:
        page = client.get("/")
        assert page.status_code == 200
        assert all(client.get(name).status_code == 200 for name in assets(page.text))
        assert client.get("/v1/models").status_code == 401
        assert client.post("/v1/planes", files=mask_parts()).status_code == 401


def test_the_page_stands_behind_a_prefix(tmp_path):
    with running(behind_prefix(app_for(tmp_path, api_keys=("k",)), "/shape")) as client:
        page = client.get("/shape/")
        assert page.status_code == 200
        assert all(client.get(httpx.URL("/shape/").join(name)).status_code == 200 for name in assets(page.text))


def drawn(answer, grid: Grid):
    """Foreground of the answered planes, as a volume."""
    values = np.zeros(grid.shape, np.uint8)
    for plane in answer["planes"]:
        section = np.moveaxis(values, plane["axis"], 0)[plane["index"]]
        flat = np.zeros(section.size, np.uint8)
        for start, length in plane["runs"]:
            flat[start : start + length] = 1
        section[...] |= flat.reshape(section.shape)
    return values


def test_planes_hold_what_is_drawn_and_where_it_lies(client):
    values, grid = sparse_ellipsoid()
    answer = client.post("/v1/planes", files=mask_parts(nifti_of(values, grid))).json()
    (stack,) = answer["stacks"]
    assert (stack["part"], tuple(stack["shape"])) == ("mask[0]", grid.shape)
    assert np.array(stack["affine"]) == pytest.approx(grid.affine)
    assert np.array_equal(drawn(answer, grid), values)


def test_planes_are_those_that_a_reconstruction_uses(client):
    for annotated in (
        "auto",
        "nonempty",
        '[{"stack": 0, "axis": 2, "index": 8}, {"stack": 0, "axis": 2, "index": 12}]',
    ):
        told = client.post("/v1/planes", files=mask_parts(), data={"annotated": annotated}).json()["planes"]
        made = client.post("/v1/reconstructions", files=mask_parts(), data={"annotated": annotated}).json()["planes"]
        assert [{key: plane[key] for key in ("stack", "axis", "index")} for plane in told] == made


def test_what_a_reconstruction_refuses_has_no_planes_in_the_same_words(client):
    values, grid = sparse_ellipsoid()
    values[:, :, 9:] = values[:, :, :8] = 0
    for data, form in (
        (nifti_of(values, grid), {}),
        (b"text", {}),
        (mask_bytes(), {"label": "7"}),
        (mask_bytes(), {"annotated": "[]"}),
    ):
        told, made = (
            client.post(path, files=mask_parts(data), data=form) for path in ("/v1/planes", "/v1/reconstructions")
        )
        assert told.status_code == made.status_code >= 400
        assert (told.json()["detail"], told.json()["part"]) == (made.json()["detail"], made.json()["part"])


def test_a_form_of_another_kind_and_too_many_masks_are_refused(tmp_path):
    with running(app_for(tmp_path, max_masks=1)) as client:
        assert client.post("/v1/planes", json={}).status_code == 415
        assert client.post("/v1/planes", files=mask_parts(mask_bytes(), mask_bytes())).status_code == 413


@pytest.fixture(scope="module")
def results(client):
    axes = ((14.0, 10.0, 8.0), (12.0, 9.0, 9.0))
    return [client.post("/v1/reconstructions", files=mask_parts(mask_bytes(one))).json()["id"] for one in axes]


def test_two_results_are_compared_from_either_side(client, results):
    def distances(one, other):
        answer = client.get(f"/v1/reconstructions/{one}/comparison", params={"other": other})
        assert answer.headers["content-type"] == "application/x-ply"
        header, _, body = answer.content.partition(b"end_header\n")
        assert b"property double signed_distance_mm" in header or b"property float signed_distance_mm" in header
        count = int(re.search(rb"element vertex (\d+)", header)[1])
        kinds = {b"float": "<f4", b"double": "<f8"}
        fields = re.findall(rb"property (float|double) (\w+)", header)
        table = np.frombuffer(body, [(name.decode(), kinds[kind]) for kind, name in fields], count)
        return table["signed_distance_mm"]

    first, second = distances(*results), distances(*reversed(results))
    assert first.max() > 0.5
    assert first.min() < -0.2
    assert first.max() == pytest.approx(-second.min(), abs=0.5)
    assert distances(results[0], results[0]) == pytest.approx(0.0, abs=1e-6)


def test_comparisons_with_what_is_not_there_are_refused(client, results):
    path = f"/v1/reconstructions/{results[0]}/comparison"
    assert client.get(path, params={"other": "nothing"}).status_code == 404
    assert client.get(path).status_code == 422
    assert client.get(path, params={"other": results[1], "format": "stl"}).status_code == 422
    assert client.get(f"/v1/models/{NAME}").status_code == 200
