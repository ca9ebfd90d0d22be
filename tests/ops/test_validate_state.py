"""One look at the rows of a state, in the sections that an op without gradients has."""

import pytest
import torch

from gsim3d.errors import GradientError
from gsim3d.ops import validate_state
from gsim3d.ops.validate_state import FAST, OUTSIDE, SUMS, join_records
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.oracle import validate_state as oracle

DTYPES = [torch.float32, torch.float64]
BOUNDS = [(-3e38, 3e38), (0.0, 1.0), (-3.5, 3.5), (0.0, 1.0), (-4.0, 4.0)]
NEUTRAL = [0.0, 0.0, 1.0, 0.0, 0.5]
CLOUDS = [0, 0, 7, 2500, 2500, 5000]


def state(clouds=CLOUDS, dtype=torch.float32, seed=0, device="cpu"):
    """(fields, bounds, cu_rows, options) of rows of which some are out of every bound, and some asleep."""
    g = torch.Generator().manual_seed(seed)
    n, n_clouds = clouds[-1], len(clouds) - 1

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    fields = [4 * torch.rand(n, 3, generator=g) - 0.2, 1.02 * torch.rand(n, generator=g), normal(n, 5), normal(n, 0)]
    fields = [field.to(dtype) for field in (*fields, normal(n, 4, 3))]
    for place, value in ((11, float("nan")), (n // 2, float("inf")), (n - 1, -float("inf"))):
        if 2 <= place < n:
            fields[0][place, place % 3] = fields[2][place - 1, 4] = fields[4][place - 2, 1, 1] = value
    options = {
        "cloud_scene": torch.arange(n_clouds) % 2,
        "origin": torch.zeros(2, 3, dtype=torch.float64),
        "activity": torch.randint(0, 3, (n,), generator=g).to(torch.uint8),
        "grid_size": 3.6 / 2**16,
        "max_step": 0.3,
    }
    options = {k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in options.items()}
    previous = [fields[0] + 0.1 * normal(n, 3), *(normal(*field.shape) for field in fields[1:])]
    options["previous"] = [field.to(device, dtype) for field in previous]
    return [field.to(device) for field in fields], BOUNDS, torch.tensor(clouds, device=device), options


def look(arguments):
    """(status, record, sanitized activity and fields)"""
    fields, bounds, cu_rows, options = arguments
    found = validate_state(fields, bounds, cu_rows, neutral=NEUTRAL, **options)
    return found.status, found.record, found.activity, *found.fields


def assert_same_record(actual, expected, n_fields):
    """Counts, rows and bounds are the same; sums of energy and opacity but for the order of their terms."""
    summed = torch.zeros(expected.shape[1], dtype=torch.bool)
    summed[2 * (n_fields + 2) + 1 : 2 * (n_fields + 2) + 3] = True
    assert_same_bits(actual.cpu()[:, ~summed], expected[:, ~summed])
    assert_close_relative_to_max(actual.cpu()[:, summed], expected[:, summed], 1e-13)


# 1 forward against the oracle


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("clouds", [CLOUDS, [0, 1], [0, 1024, 2048], [0, *range(1, 40), 1030, 1030, 2047, 4100]])
def test_equals_the_oracle(clouds, dtype, device):
    fields, bounds, cu_rows, options = state(clouds, dtype)
    expected_status, expected = oracle.validate_state(fields, bounds, cu_rows, **options)
    status, record, *_ = look(state(clouds, dtype, device=device))
    assert_same_bits(status.cpu(), expected_status)
    assert_same_record(record, expected, len(fields))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("clouds", [CLOUDS, [0, *range(1, 40), 1030, 1030, 2047, 4100]])
@pytest.mark.parametrize("knows_previous", [True, False])
def test_mends_as_the_oracle(clouds, dtype, knows_previous, device):
    fields, bounds, cu_rows, options = state(clouds, dtype)
    previous = options["previous"] if knows_previous else None
    options |= {"origin": torch.tensor([[0.1, -0.2, 0.3], [-0.05, 0.7, 0.0]], dtype=torch.float64)}
    status, _ = oracle.validate_state(fields, bounds, cu_rows, **options | {"previous": previous})
    clouds = {name: options[name] for name in ("cloud_scene", "origin", "activity")}
    expected = oracle.sanitized(fields, status, NEUTRAL, cu_rows, previous=previous, **clouds)
    fields, bounds, cu_rows, moved = state(clouds=cu_rows.tolist(), dtype=dtype, device=device)
    moved |= {"origin": options["origin"].to(device), "previous": moved["previous"] if knows_previous else None}
    _, _, *sanitized = look((fields, bounds, cu_rows, moved))
    for actual, wanted, before in zip(sanitized, expected, (moved["activity"], *fields), strict=True):
        assert_same_bits(actual.cpu(), wanted)
        assert actual.data_ptr() != before.data_ptr() or not before.numel()
    assert bool((expected[0] != options["activity"]).any()) and bool((expected[1] != fields[0].cpu()).any())


def test_rows_are_sanitized_only_if_asked():
    fields, bounds, cu_rows, options = state()
    found = validate_state(fields, bounds, cu_rows, **options)
    assert found.fields is None and found.activity is None
    assert_same_bits(found.status, look(state())[0])


def test_counts():
    means = torch.tensor(
        [[0.5, 0.5, 0.5], [0.5, float("nan"), 0.5], [-0.1, 0.5, 0.5], [0.9, 0.5, 0.5], [3.0, 0.5, 0.5]]
    )
    opacities = torch.tensor([0.25, 0.5, 0.5, 1.0, 2.0])
    found = validate_state(
        [means, opacities],
        [(-9.0, 9.0), (0.0, 1.0)],
        torch.tensor([0, 5]),
        cloud_scene=torch.zeros(1, dtype=torch.int64),
        origin=torch.zeros(1, 3, dtype=torch.float64),
        activity=torch.tensor([0, 0, 1, 0, 2], dtype=torch.uint8),
        grid_size=1.0,
        previous=[torch.tensor([[0.5, 0.5, 0.1]] + [[0.5, 0.5, 0.5]] * 4), opacities],
        max_step=0.7,
    )
    assert found.status.tolist() == [0, 1, OUTSIDE, 0, 0]
    record = found.record[0].tolist()
    assert record[:8] == [1, 1, 0, -1, 1, 2, 0, -1]
    sums = dict(zip(SUMS, record[8:], strict=True))
    assert sums["awake"] == 2 and sums["opacity_mass"] == 2.25  # all but the row whose opacity is 2
    assert sums["kinetic_energy"] == pytest.approx((0.4**2 + 0.4**2) / 2, rel=1e-6)
    assert (sums["low_x"], sums["high_x"]) == pytest.approx((0.5, 0.9))
    fast = validate_state(
        [means, opacities],
        [(-9.0, 9.0), (0.0, 1.0)],
        torch.tensor([0, 5]),
        cloud_scene=torch.zeros(1, dtype=torch.int64),
        origin=torch.zeros(1, 3, dtype=torch.float64),
        activity=torch.zeros(5, dtype=torch.uint8),
        previous=[torch.full((5, 3), 0.5), opacities],
        max_step=0.5,
    )
    assert fast.status.tolist() == [0, 1, FAST, 0, FAST | 2]


# 4 CPU against CUDA: section 1 compares both with the oracle; here bits, from run to run


def test_repeats_bit_by_bit(device):
    first = look(state(device=device))
    for a, b in zip(look(state(device=device)), first, strict=True):
        assert_same_bits(a, b)


def test_waits_for_nothing_on_cuda(devices):
    arguments = state(device=devices[1])
    look(arguments)
    torch.cuda.set_sync_debug_mode("error")
    try:
        look(arguments)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_any_offsets_stay_in_bounds_on_cuda(devices):
    fields, bounds, cu_rows, options = state(device=devices[1])
    for offsets in ([0, -5, 9999, 3, 5000, 4000], [5000, 0, 0, 0, 0, 5000], [2**60] * 6):
        look((fields, bounds, torch.tensor(offsets, device=devices[1]), options))
    options["cloud_scene"] = options["cloud_scene"] + 2**40
    status = look((fields, bounds, cu_rows, options))[0]
    assert not bool((status & OUTSIDE).any())


@pytest.mark.parametrize("clouds", [[0, 3, 9], [0, 0, 7, 2500, 2500, 5000], [0], [0, 0]])
def test_records_of_several_looks_are_joined_at_once(clouds, device):
    looks = [state(q, seed=seed, device=device) for seed, q in enumerate((clouds, [0, 10, 9000], clouds))]
    looks[1] = (looks[1][0][:2], looks[1][1][:2], looks[1][2], looks[1][3] | {"previous": None})
    parts = [
        validate_state(fields, bounds, cu_rows, join=False, **options) for fields, bounds, cu_rows, options in looks
    ]
    whole = [validate_state(fields, bounds, cu_rows, **options) for fields, bounds, cu_rows, options in looks]
    for a, b in zip(parts, whole, strict=True):
        assert a.record.shape == b.record.shape and a.record.dtype == b.record.dtype
        assert a.record.device == b.record.device
    assert_same_bits(
        join_records([look.record for look in parts]), torch.cat([look.record.reshape(-1) for look in whole])
    )


def test_more_looks_than_a_launch_takes(device):
    fields, bounds, cu_rows, options = state([0, 3, 9], device=device)
    one = validate_state(fields, bounds, cu_rows, join=False, **options).record
    records = join_records([one] * 70).view(70, *one.shape)
    assert_same_bits(records[69], validate_state(fields, bounds, cu_rows, **options).record)
    assert_same_bits(records, records[:1].expand_as(records))


def test_offsets_that_descend_count_nothing_on_cuda(devices):
    fields, bounds, cu_rows, options = state(device=devices[1])
    descending = torch.tensor([0, 4000, 300, 5000, 5000, 5000], device=devices[1])
    record = validate_state(fields, bounds, descending, **options).record
    assert bool((record[:, 0:14:2] == 0).all()) and bool((record[:, 1:14:2] == -1).all())


# 5 opcheck


def test_opcheck(device):
    fields, bounds, cu_rows, options = state([0, 3, 9], device=device)
    low, high = map(list, zip(*bounds))
    names = ("cloud_scene", "origin", "activity", "previous", "grid_size", "max_step")
    arguments = (fields, low, high, cu_rows, *(options[name] for name in names))
    for neutral in ([], NEUTRAL):
        torch.library.opcheck(torch.ops.gsim3d.validate_state, (*arguments, neutral))
    torch.library.opcheck(torch.ops.gsim3d.validate_state, (*arguments, [], False))
    parts = torch.ops.gsim3d.validate_state(*arguments, [], False)[1]
    torch.library.opcheck(torch.ops.gsim3d.join_records, ([parts, parts], [cu_rows, cu_rows], [9, 9]))


# 6 torch.compile


def test_compiles(device):
    fields, bounds, cu_rows, options = state([0, 3, 9], device=device)

    def f(means):
        found = validate_state([means, *fields[1:]], bounds, cu_rows, neutral=NEUTRAL, **options)
        return found.status + 0, found.fields[2]

    for a, b in zip(torch.compile(f, fullgraph=True)(fields[0]), f(fields[0]), strict=True):
        assert_same_bits(a, b)


# 7 edges


def test_any_number_of_threads():
    arguments = state([0, 10, 9000])
    assert_same_bits_for_any_threads(lambda: look(arguments))


@pytest.mark.parametrize("clouds", [[0], [0, 0], [0, 0, 0]])
def test_empty_rows(clouds, device):
    status, record, *_ = look(state(clouds, device=device))
    assert status.shape == (0,) and record.shape == (len(clouds) - 1, 2 * 7 + 9)
    assert bool((record[:, 0:14:2] == 0).all()) and bool((record[:, 1:14:2] == -1).all())


def test_strided_field(device):
    fields, bounds, cu_rows, options = state(device=device)
    strided = [torch.stack([field, field], 1)[:, 0] for field in fields]
    assert not strided[0].is_contiguous()
    for a, b in zip(look((strided, bounds, cu_rows, options)), look((fields, bounds, cu_rows, options)), strict=True):
        assert_same_bits(a, b)


def test_gradients_pass_by():
    fields, bounds, cu_rows, options = state()
    leaves = [field.requires_grad_() for field in fields]
    assert not validate_state(leaves, bounds, cu_rows, **options).record.requires_grad
    with pytest.raises(GradientError, match=r"validate_state: fields\[0\] has no gradient"):
        validate_state(leaves, bounds, cu_rows, neutral=NEUTRAL, **options)
    with torch.no_grad():
        assert not validate_state(leaves, bounds, cu_rows, neutral=NEUTRAL, **options).fields[0].requires_grad


# 8 error messages


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f, o: (f[:1], o), "fields must be 2 to 9 tensors, positions and opacities first; got 1"),
        (lambda f, o: ([f[0][:, :2], *f[1:]], o), r"fields\[0\] must be \[N, 3\]"),
        (lambda f, o: ([f[0], f[1][:3], *f[2:]], o), r"fields\[1\] must be \[N\]"),
        (lambda f, o: ([*f[:2], f[2].double(), *f[3:]], o), "fields must be float32; got float64"),
        (lambda f, o: ([*f[:2], f[2][:4], *f[3:]], o), r"fields must have N=5000 rows; got \[4, 5\]"),
        (lambda f, o: (f, o | {"origin": o["origin"].float()}), "origin must be float64; got float32"),
        (lambda f, o: (f, o | {"activity": o["activity"].long()}), "activity must be uint8; got int64"),
        (
            lambda f, o: (f, o | {"previous": o["previous"][:4]}),
            "previous must have one entry for each of 5 fields; got 4",
        ),
        (
            lambda f, o: (f, o | {"previous": [x[:9] for x in o["previous"]]}),
            r"previous\[0\] must have the shape of its field, \[5000, 3\]; got \[9, 3\]",
        ),
        (lambda f, o: (f, o | {"neutral": [0.0]}), "neutral must have one entry for each of 5 fields; got 1"),
        (
            lambda f, o: (f, o | {"cloud_scene": o["cloud_scene"] + 1}),
            r"cloud_scene must be in \[0, B\) with B=2; got 2",
        ),
    ],
)
def test_errors_name_what_is_wrong(change, message):
    fields, bounds, cu_rows, options = state()
    fields, options = change(fields, options)
    with pytest.raises(ValueError, match="(validate_state|validate_state): .*" + message):
        options["previous"] = options["previous"] if len(fields) == 5 else None
        validate_state(fields, bounds[: len(fields)], cu_rows, **options)


def test_parts_that_do_not_fit():
    fields, bounds, cu_rows, options = state()
    record = validate_state(fields, bounds, cu_rows, join=False, **options).record
    for wrong, message in (
        (record._replace(n_rows=9000), "parts must be as validate_state left them, 13 of 9000 rows; got"),
        (record._replace(parts=record.parts[:, 1:]), "parts must be as validate_state left them"),
        (record._replace(parts=record.parts.float()), "parts must be float64; got float32"),
        (record._replace(cu_rows=cu_rows.int()), "cu_rows must be int64; got int32"),
        (record._replace(cu_rows=cu_rows.flip(0)), "cu_rows must run from 0 to N=5000; got 5000"),
    ):
        with pytest.raises(ValueError, match="join_records: " + message):
            join_records([record, wrong])
    with pytest.raises(ValueError, match="join_records: parts must be of one look at least"):
        torch.ops.gsim3d.join_records([record.parts], [], [5000])


def test_offsets_that_do_not_fit():
    fields, bounds, _, options = state()
    for offsets in ([0, 0, 7, 2500, 2500, 4999], [0, 9, 7, 2500, 2500, 5000]):
        with pytest.raises(ValueError, match="validate_state: cu_rows must"):
            validate_state(fields, bounds, torch.tensor(offsets), **options)
