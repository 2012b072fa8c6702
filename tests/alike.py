"""Whether two trees of tensors are the same, and a filter beside its compiled copy."""

import copy

import torch


def close(a, b, tolerance=1e-10):
    """All tensors of two trees, relative to the largest entry."""
    if a is None or isinstance(a, torch.Tensor):
        assert (a is None) == (b is None)
        if a is not None:
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            scale = a.double().abs().nan_to_num(posinf=0).max().clamp_min(1e-300) if a.numel() else 1.0
            torch.testing.assert_close(b.double() / scale, a.double() / scale, rtol=0, atol=tolerance, equal_nan=True)
        return
    for x, y in zip(a, b, strict=True):
        close(x, y, tolerance)


def both(f, *args, **kwargs):
    """What a filter gives, and what it gives compiled."""
    return f(*args, **kwargs), copy.deepcopy(f).compile()(*args, **kwargs)
