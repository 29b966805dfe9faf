import numpy as np
import pytest
import torch

from model.backends import Decoder, Prior, load_onnx, load_torchscript
from model.bundle import open_bundle

pytestmark = [
    pytest.mark.xdist_group("exported"),
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
]

LOADERS = {"onnx": load_onnx, "torchscript": load_torchscript}


def codes(count=6, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


def points(count=6, number=31):
    return 12.0 * np.random.default_rng(1).normal(size=(count, number, 3))


@pytest.fixture(params=LOADERS)
def backend(request, exported) -> tuple[Decoder, Prior]:
    return LOADERS[request.param](exported.folder, 3, 1)


def close(found, expected, tolerance=1e-4):
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def single(values):
    return torch.from_numpy(values.astype(np.float32))


def test_the_decoder_is_the_network(backend, exported):
    decoder, _ = backend
    assert decoder.latent_size == 3
    close(decoder.logits(codes(), points()), exported.decoder(single(codes()), single(points())).numpy())
    expected = exported.decoder.jacobians(single(codes()), single(points()))
    for found, want in zip(decoder.logits_and_jacobians(codes(), points()), expected, strict=True):
        close(found, want.numpy())
    for found, want in zip(decoder.logits_and_gradients(codes(), points()), expected[::2], strict=True):
        close(found, want.numpy())


def test_the_prior_is_the_network(backend, exported):
    _, prior = backend
    assert prior.latent_size == 3
    close(prior.log_density(codes())[0], exported.prior.log_density(single(codes())).numpy(), 1e-3)
    close(prior.to_base(codes()), exported.prior.to_base(single(codes()))[0].numpy(), 1e-3)
    close(prior.from_base(codes()), exported.prior.from_base(single(codes())).numpy(), 1e-3)


def test_base_coordinates_lead_back_to_the_code(backend):
    _, prior = backend
    close(prior.from_base(prior.to_base(codes())), codes(), 1e-3)
    close(prior.to_base(prior.from_base(codes())), codes(), 1e-3)
    assert np.abs(prior.to_base(codes()) - codes()).max() > 0.1


def finite_differences(function, at, step=2e-3):
    columns = [(function(at + step * axis) - function(at - step * axis)) / (2 * step) for axis in np.eye(at.shape[1])]
    return np.stack(columns, axis=-1)


def test_jacobian_of_the_base_is_that_of_finite_differences(backend):
    _, prior = backend
    base, jacobian = prior.base_jacobian(codes())
    close(base, prior.to_base(codes()), 1e-5)
    close(jacobian, finite_differences(prior.to_base, codes()), 2e-2)


def test_gradient_of_the_density_is_that_of_finite_differences(backend):
    _, prior = backend
    _, gradient = prior.log_density(codes())
    close(gradient, finite_differences(lambda z: prior.log_density(z)[0], codes()), 5e-2)


def test_both_runtimes_agree(exported):
    (one, prior_one), (other, prior_other) = (load(exported.folder, 3, 1) for load in LOADERS.values())
    for found, want in zip(
        one.logits_and_jacobians(codes(), points()), other.logits_and_jacobians(codes(), points()), strict=True
    ):
        close(found, want)
    for found, want in zip(prior_one.log_density(codes()), prior_other.log_density(codes()), strict=True):
        close(found, want, 1e-3)
    for found, want in zip(prior_one.base_jacobian(codes()), prior_other.base_jacobian(codes()), strict=True):
        close(found, want, 1e-3)
    close(prior_one.from_base(codes()), prior_other.from_base(codes()), 1e-3)


def test_arrays_of_any_layout_are_taken_and_left_alone(backend):
    decoder, prior = backend
    frozen = codes().astype(np.float32)
    frozen.setflags(write=False)
    strided = np.asfortranarray(points())
    close(decoder.logits(frozen, strided), decoder.logits(codes(), points()), 1e-5)
    close(prior.log_density(frozen)[0], prior.log_density(codes())[0], 1e-5)
    close(prior.from_base(frozen), prior.from_base(codes()), 1e-5)
    assert np.array_equal(frozen, codes().astype(np.float32))


def test_a_shape_does_not_depend_on_those_beside_it(backend):
    decoder, prior = backend
    close(decoder.logits(codes()[2:3], points()[2:3]), decoder.logits(codes(), points())[2:3], 1e-5)
    close(prior.from_base(codes()[2:3]), prior.from_base(codes())[2:3], 1e-5)


def test_in_shipped_models_base_coordinates_lead_back_to_the_codes(shipped_bundles):
    for folder in shipped_bundles:
        model = open_bundle(folder, threads=1)
        base = model.prior.to_base(model.population.codes)
        close(base, model.population.base_codes, 1e-3)
        close(model.prior.from_base(base), model.population.codes, 1e-3)
