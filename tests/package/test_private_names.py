"""What the library uses of torch that torch calls private: all of it is listed here, and all of it is there."""

import pkgutil
import re
from pathlib import Path

import pytest
import torch

import torchfra

LIBRARY = Path(torchfra.__file__).parent
PRIVATE = {
    "torch._C._functorch.is_functorch_wrapped_tensor": "linalg/tracing.py knows by it whether a transform is at work",
    "torch._C._functorch.peek_interpreter_stack": "compiler/one_operation.py: no kernel runs inside a transform",
    "torch._C._DisableTorchDispatch": "compiler/operations.py changes the shape of a tensor without numbers",
    "torch._C._disabled_torch_function_impl": "compiler/entries.py sees operations, not functions",
    "torch._decomp.decomposition_table": "compiler/operations.py takes apart operations that it does not know",
    "torch._ops.OpOverload": "compiler/operations.py finds the operations that write in place",
    "torch.utils._pytree.tree_flatten": "compiler/entries.py and compiler/moves.py look for entries among arguments",
    "torch.utils._pytree.tree_map": "compiler/moves.py moves the numbers of entries",
    "torch.Tensor._make_wrapper_subclass": "compiler/entries.py makes a tensor without memory",
    "torch.Tensor._is_zerotensor": "compiler/entries.py and program.py know zeros of forward-mode differentiation",
    "torch.autograd.forward_ad._current_level": "kernels and tria know by it whether derivatives go forwards",
    "torch._neg_view": "testing/results.py makes a tensor that is negated late",
    "torch.ops.aten.mul.Tensor._schema": "compiler/operations.py names the operation in place",
    "torch.ops.aten.mul.Tensor._overloadname": "compiler/operations.py names the operation in place",
}
"""Names without which something does not work, and what."""
GUARDED = {
    "torch._C._dynamo.guards": "compiler/forms.py has a slower check of its own, pages.py empty_strided",
    "torch._C._autograd._top_saved_tensors_default_hooks": "compiler/forms.py: calls with a gradient do not get ready",
    "torch._C._current_autograd_node": "compiler/origin.py then names no line in comments of gradients",
    "torch.autograd._get_sequence_nr": "likewise",
    "torch._dynamo": "association/events.py only marks a function for torch.compile",
}
"""Names without which all still works."""


def used(text):
    """The private names of torch in a text, as it writes them: paths from ``torch``, imports and attributes."""
    paths = re.findall(r"\btorch(?:\.[A-Za-z]\w*)*\._[a-zA-Z]\w*(?:\.\w+)*", text)
    imports = [f"{a}.{b}" for a, b in re.findall(r"from (torch[\w.]*\._\w+) import (\w+)", text)]
    known = "|".join(name.rpartition(".")[2] for name in PRIVATE if name.rpartition(".")[2].startswith("_"))
    return {*paths, *imports, *re.findall(rf"\b\w+\.(?:{known})\b", text)}


def listed(name):
    """Whether a name, as it is written somewhere, is one of the lists' or on the way to one."""
    return any(
        full.startswith(name) or name.startswith(full) or full.rpartition(".")[2] == name.rpartition(".")[2]
        for full in PRIVATE | GUARDED
    )


@pytest.mark.parametrize("name", PRIVATE)
def test_a_private_name_of_torch_is_still_there(name):
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        pytest.fail(f"torch {torch.__version__} has no {name} any more: {PRIVATE[name]}")


def test_private_names_are_listed():
    for path in sorted(LIBRARY.rglob("*.py")):
        new = sorted(name for name in used(path.read_text(encoding="utf-8")) if not listed(name))
        assert not new, f"{path.relative_to(LIBRARY)} uses {new}: prefer a public name, or list it in this file"


def test_private_names_are_found_however_they_are_written():
    text = "from torch._decomp import x\ny = torch._C._nn.gelu(t)\nfrom torch.utils._pytree import z\nt._schema"
    assert used(text) >= {"torch._decomp.x", "torch._C._nn.gelu", "torch.utils._pytree.z", "t._schema"}
    assert [listed(x) for x in ("torch._decomp.x", "torch._C._nn.gelu", "t._schema")] == [False, False, True]


@pytest.mark.parametrize(("owner", "name", "begins"), [
    (torch.autograd, "_get_sequence_nr", "nothing"), (torch._C, "_current_autograd_node", "test_private_names"),
])  # fmt: skip
def test_without_torchs_numbers_of_operations_a_comment_names_the_line_alone(monkeypatch, owner, name, begins):
    from torchfra.compiler import origin

    monkeypatch.setattr(origin, "_DIFFERENTIATED", begins)  # where a gradient pass begins
    monkeypatch.delattr(owner, name)
    origins = origin.Origins()
    assert (lambda: origins.here())().startswith("test_private_names.py:")
