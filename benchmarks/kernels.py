"""How much of the machine's arithmetic the network uses, in the fit and in the surface.

Counts the multiplications and additions of the graphs' matrix products a point, measures the time of the decoder's
calls at the sizes of the fit (one shape, some thousand points, with Jacobians) and of the surface (as they come while
one is extracted), and the rate of a plain single-precision matrix product in between. The best of the repeats counts:
what else runs on the machine only adds time. Both use as many threads as ``OMP_NUM_THREADS`` says, all cores without.

    OMP_NUM_THREADS=2 python -m benchmarks.kernels
"""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import onnx
import onnx.utils
import typer
from jaxtyping import Float

from model.backends import Decoder
from model.bundle import ShapeModel, open_bundle
from model.geometry import Pose
from model.inference.surface import canonical_box, surface_of

SHIPPED = Path(__file__).resolve().parents[1] / "model" / "bundles"
MATRIX_SIZE = 1024
FIT_POINTS = 2500
#: Operations a point of logits alone, with Jacobians, and with the derivatives by point only.
APoint = tuple[float, float, float]


@dataclass
class Share:
    """Best time of one kind of work.

    Attributes:
        calls, points: of the network, in one piece of work.
        operations: multiplications and additions of the matrix products.
        seconds: in the network.
    """

    calls: int = 0
    points: int = 0
    operations: float = 0.0
    seconds: float = 0.0

    @property
    def rate(self) -> float:
        """GFLOP/s."""
        return self.operations / self.seconds / 1e9

    def add(self, points: int, operations: float, seconds: float) -> None:
        """One call more."""
        self.calls, self.points = self.calls + 1, self.points + points
        self.operations, self.seconds = self.operations + operations, self.seconds + seconds


@dataclass
class TimedDecoder:
    """A decoder that keeps account of the time spent in it."""

    decoder: Decoder
    a_point: APoint
    spent: Share
    latent_size: int

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """See `Decoder`."""
        begin = time.perf_counter()
        result = self.decoder.logits(latent, points)
        self._note(points, self.a_point[0], begin)
        return result

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        begin = time.perf_counter()
        result = self.decoder.logits_and_jacobians(latent, points)
        self._note(points, self.a_point[1], begin)
        return result

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        begin = time.perf_counter()
        result = self.decoder.logits_and_gradients(latent, points)
        self._note(points, self.a_point[2], begin)
        return result

    def _note(self, points: Float[np.ndarray, "b n 3"], operations: float, begin: float) -> None:
        count = points.shape[0] * points.shape[1]
        self.spent.add(count, operations * count, time.perf_counter() - begin)


def main(
    bundle: Annotated[Path, typer.Option(help="Folder of a bundle.")] = SHIPPED / "hippocampus",
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Repeats; the best counts.")] = 30,
) -> None:
    """Fraction of the machine's matrix-product rate that fit and surface reach in the network."""
    threads = int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1))
    model = open_bundle(bundle, threads=threads)
    jacobians = bundle / "decoder_jacobians.onnx"
    a_point = (
        operations_a_point(bundle / "decoder_logits.onnx", ("logits",)),
        operations_a_point(jacobians, ("logits", "by_latent", "by_point")),
        operations_a_point(jacobians, ("logits", "by_point")),
    )
    best, rate = measure(model, a_point, repeats)
    typer.echo(f"threads {threads}, matrix product {rate:.0f} GFLOP/s (float32, {MATRIX_SIZE} x {MATRIX_SIZE})")
    typer.echo(f"{'work':<10}{'calls':>7}{'points':>9}{'GFLOP':>9}{'ms':>9}{'GFLOP/s':>10}{'fraction':>10}")
    for name, share in best.items():
        typer.echo(
            f"{name:<10}{share.calls:>7}{share.points:>9}{share.operations / 1e9:>9.2f}"
            f"{1e3 * share.seconds:>9.2f}{share.rate:>10.1f}{share.rate / rate:>10.2f}"
        )


def measure(model: ShapeModel, a_point: APoint, repeats: int) -> tuple[dict[str, Share], float]:
    """Best shares of fit and surface, and the best rate of a matrix product (GFLOP/s), measured in turn."""
    works = {"fit": _fit_call, "surface": _surface}
    best: dict[str, Share] = {}
    rate = 0.0
    for _ in range(repeats):
        rate = max(rate, matrix_rate())
        for name, work in works.items():
            share = _spent(model, a_point, work)
            if name not in best or share.seconds < best[name].seconds:
                best[name] = share
    sums = [
        sum(getattr(share, name) for share in best.values()) for name in ("calls", "points", "operations", "seconds")
    ]
    return {**best, "together": Share(*sums)}, rate


def matrix_rate() -> float:
    """Rate of one plain matrix product (GFLOP/s)."""
    a = np.random.default_rng(0).standard_normal((MATRIX_SIZE, MATRIX_SIZE), dtype=np.float32)
    begin = time.perf_counter()
    a @ a
    return float(2.0 * MATRIX_SIZE**3 / (time.perf_counter() - begin) / 1e9)


def operations_a_point(path: Path, outputs: Sequence[str]) -> float:
    """Multiplications and additions of the matrix products that a graph needs for some of its outputs, a point."""
    wanted = onnx.utils.Extractor(onnx.load(path)).extract_model(["latent", "points"], list(outputs))
    graph = onnx.shape_inference.infer_shapes(wanted).graph
    sizes = {item.name: list(item.dims) for item in graph.initializer}
    for value in (*graph.value_info, *graph.input, *graph.output):
        sizes.setdefault(value.name, [side.dim_value for side in value.type.tensor_type.shape.dim])
    products = [node for node in graph.node if node.op_type in ("Gemm", "MatMul") and node.input[0] != "latent"]
    return sum(2.0 * float(np.prod(sizes[node.input[1]])) for node in products)


def _spent(model: ShapeModel, a_point: APoint, work: Callable[[ShapeModel], object]) -> Share:
    timed = TimedDecoder(model.decoder, a_point, Share(), model.manifest.latent_size)
    work(replace(model, decoder=timed))
    return timed.spent


def _fit_call(model: ShapeModel) -> object:
    """One evaluation of the fit's objective."""
    half = canonical_box(model)
    points = np.random.default_rng(1).uniform(-half, half, size=(1, FIT_POINTS, 3))
    return model.decoder.logits_and_jacobians(np.zeros((1, model.manifest.latent_size)), points)


def _surface(model: ShapeModel) -> object:
    return surface_of(model, np.zeros(model.manifest.latent_size), Pose())


if __name__ == "__main__":
    typer.run(main)
