import pytest
import torch
from torch import Tensor

from model.networks.flow import FlowShape, SplineFlow, SplineTransform
from tests.random_networks import jacobian, randomise

SIZES = [1, 2, 5, 12]


def flow_of(size: int, seed: int = 0, transforms: int = 3) -> SplineFlow:
    flow = SplineFlow(FlowShape(latent_size=size, transforms=transforms, bins=4, width=10, bound=3.0)).double()
    randomise(flow, seed, 0.4)
    return flow


def codes(size: int, count: int = 9) -> Tensor:
    random = torch.Generator().manual_seed(size)
    return 1.7 * torch.randn(count, size, generator=random, dtype=torch.float64)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("seed", [0, 1])
def test_inverse_undoes_forward_and_forward_undoes_inverse(size, seed):
    flow, x = flow_of(size, seed), codes(size)
    with torch.no_grad():
        y, _ = flow(x)
        torch.testing.assert_close(flow.inverse(y), x)
        torch.testing.assert_close(flow(flow.inverse(x))[0], x)
    assert (y - x).abs().max() > 0.1


@pytest.mark.parametrize("size", SIZES)
def test_log_determinant_is_that_of_the_jacobian(size):
    flow, x = flow_of(size), codes(size)
    found = torch.linalg.slogdet(jacobian(lambda v: flow(v)[0], x))
    torch.testing.assert_close(flow(x)[1], found.logabsdet)
    assert (found.sign == 1).all()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("reverse", [False, True])
def test_jacobian_is_triangular_in_the_transforms_own_order(size, reverse):
    transform = SplineTransform(FlowShape(latent_size=size, bins=4, width=12), reverse=reverse).double()
    randomise(transform, 0, 0.4)
    found = jacobian(lambda v: transform(v)[0], codes(size))
    found = found.flip(1, 2) if reverse else found
    assert not found.triu(1).any()
    assert (found.diagonal(dim1=1, dim2=2) > 0).all()
    below = torch.ones(size, size).tril(-1).bool()
    assert (found.abs().amax(dim=0)[below] > 0).all()


@pytest.mark.parametrize("reverse", [False, True])
def test_fixed_point_settles_one_dimension_a_step_from_any_guess(reverse):
    size = 6
    transform = SplineTransform(FlowShape(latent_size=size, bins=4, width=12), reverse=reverse).double()
    randomise(transform, 3, 0.4)
    with torch.no_grad():
        y = transform(codes(size))[0]
        exact = transform.inverse(y)
        order = range(size - 1, -1, -1) if reverse else range(size)
        guess = codes(size).flip(0)
        for settled in range(1, size + 1):
            guess = transform.inverse_step(y, guess)
            dimensions = list(order)[:settled]
            assert torch.equal(guess[:, dimensions], exact[:, dimensions])
        assert torch.equal(transform.inverse_step(y, guess), guess)


def test_transforms_alternate_their_order():
    flow = flow_of(4, transforms=2)
    first, second = (jacobian(lambda v, t=transform: t(v)[0], codes(4)) for transform in flow.transforms)
    assert not first.triu(1).any()
    assert not second.tril(-1).any()
    both = jacobian(lambda v: flow(v)[0], codes(4))
    assert both.triu(1).any()
    assert both.tril(-1).any()


def test_a_fresh_flow_is_the_identity():
    flow, x = SplineFlow(FlowShape(latent_size=5)).double(), codes(5)
    y, log_det = flow(x)
    torch.testing.assert_close(y, x)
    assert log_det.abs().max() < 1e-9


def test_shapes_of_a_batch_do_not_touch_each_other():
    flow, x = flow_of(5), codes(5)
    y, log_det = flow(x)
    for row in range(len(x)):
        alone = flow(x[row : row + 1])
        torch.testing.assert_close(alone, (y[row : row + 1], log_det[row : row + 1]))


@pytest.mark.parametrize("size", SIZES)
def test_jacobian_is_that_of_automatic_differentiation(size):
    flow, x = flow_of(size), codes(size)
    with torch.no_grad():
        y, found = flow.jacobian(x)
    torch.testing.assert_close(y, flow(x)[0])
    torch.testing.assert_close(found, jacobian(lambda v: flow(v)[0], x))
