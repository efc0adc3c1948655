"""The Pi-Sigma network is a product of sums with fixed weights that are not trained."""

import copy

import pytest
import torch
from testing.closeness import assert_close

from pisigma.network.pi_sigma import PiSigma, products_of_others

ORDERS = [(1,), (2,), (3,), (5,), (1, 2, 3), (2, 2)]


def network(orders, generator, inputs=3, outputs=2, dtype=torch.float64, **options) -> PiSigma:
    net = PiSigma(inputs, outputs, orders, dtype=dtype, **options)
    net.initialise(0.4, generator)
    for name in ("input_offset", "output_offset"):
        setattr(net, name, torch.randn(getattr(net, name).shape, generator=generator).to(dtype))
    for name in ("input_scale", "output_scale"):
        setattr(net, name, (0.5 + torch.rand(getattr(net, name).shape, generator=generator)).to(dtype))
    return net


def by_hand(net: PiSigma, x: list[float], output: int) -> float:
    net = copy.deepcopy(net).requires_grad_(False)
    scaled = [(v - float(o)) / float(s) for v, o, s in zip(x, net.input_offset, net.input_scale, strict=True)]
    total, unit = 0.0, 0
    for order in net.orders:
        product = 1.0
        for _ in range(order):
            h = float(net.bias[output, unit])
            for i, value in enumerate(scaled):
                h += float(net.weight[output, unit, i]) * value
            product *= float(net.fixed[output, unit]) * h
            unit += 1
        total += product
    return float(net.output_offset[output]) + float(net.output_scale[output]) * total


@pytest.mark.parametrize("orders", ORDERS)
@pytest.mark.parametrize("fixed_product", [1.0, 0.1])
def test_it_equals_a_product_of_sums_written_by_hand(orders, fixed_product, generator):
    net = network(orders, generator, fixed_product=fixed_product)
    x = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    expected = [[by_hand(net, row, k) for k in range(2)] for row in x.tolist()]
    assert_close(net(x), torch.tensor(expected, dtype=torch.float64), rtol=1e-12)


@pytest.mark.parametrize("orders", ORDERS)
def test_permuting_the_summing_units_of_a_product_changes_nothing(orders, generator):
    net = network(orders, generator)
    x = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    before = net(x).detach()
    start, order = 0, []
    for size in orders:
        order += (start + torch.randperm(size, generator=generator)).tolist()
        start += size
    with torch.no_grad():
        for values in (net.weight, net.bias, net.fixed):
            values.copy_(values[:, order].clone())
    assert_close(net(x), before, rtol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batch_shapes_and_dtypes(batch, dtype, generator):
    net = network((1, 2, 3), generator, dtype=dtype)
    x = torch.randn(*batch, 3, generator=generator).to(dtype)
    y = net(x)
    assert y.shape == (*batch, 2)
    assert y.dtype == dtype
    rows = [net(row) for row in x.reshape(-1, 3)]
    looped = torch.stack(rows).reshape(y.shape) if rows else y
    assert_close(y, looped, rtol=1e-5 if dtype == torch.float32 else 1e-13)


def test_both_dtypes_have_the_same_start():
    nets = [PiSigma(3, 2, (2,), dtype=dtype) for dtype in (torch.float32, torch.float64)]
    for net in nets:
        net.initialise(0.3, torch.Generator().manual_seed(5))
    assert_close(nets[0].weight, nets[1].weight.float(), atol=0)


@pytest.mark.parametrize("orders", [(1,), (3,), (6,)])
def test_products_start_near_one(orders, generator):
    net = PiSigma(2, 50, orders)
    net.initialise(0.1, generator)
    y = net.products(torch.zeros(1, 2, dtype=torch.float64))
    assert_close(y, torch.ones_like(y), atol=1.1 ** orders[0] - 1)
    assert float(y.detach().std()) > 0


def test_fixed_weights_are_a_buffer_and_not_a_parameter():
    net = PiSigma(2, 3, (1, 2), fixed_product=0.25)
    assert set(dict(net.named_parameters())) == {"weight", "bias"}
    assert "fixed" in dict(net.named_buffers())
    assert not net.fixed.requires_grad
    assert_close(net.fixed, torch.tensor([[0.25, 0.5, 0.5]] * 3, dtype=torch.float64), atol=1e-16)


def test_scaling_is_in_the_state(generator):
    net = network((2,), generator)
    again = PiSigma(3, 2, (2,))
    again.load_state_dict(net.state_dict())
    x = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    assert_close(again(x), net(x), atol=0)
    y = net(x)
    assert_close(net.scale_targets(y), net.products(net.scale_inputs(x)), rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "options"),
    [((0, 1, (1,)), {}), ((1, 0, (1,)), {}), ((1, 1, ()), {}), ((1, 1, (2, 0)), {}),
     ((1, 1, (1,)), {"fixed_product": 0.0}), ((1, 1, (1,)), {"fixed_product": float("nan")})],
)  # fmt: skip
def test_impossible_networks_are_rejected(arguments, options):
    with pytest.raises(ValueError, match="got"):
        PiSigma(*arguments, **options)


@pytest.mark.parametrize("zeros", [(), (0,), (2,), (0, 2), (0, 1, 2)])
def test_products_of_others_are_exact_where_factors_are_zero(zeros):
    values = torch.tensor([2.0, 3.0, 5.0, 7.0], dtype=torch.float64)
    values[list(zeros)] = 0.0
    v = values.tolist()
    expected = torch.tensor([v[1] * v[2], v[0] * v[2], v[0] * v[1], 1.0], dtype=torch.float64)
    assert_close(products_of_others(values, (3, 1)), expected, atol=0)
