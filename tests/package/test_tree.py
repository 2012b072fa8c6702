"""One map over tuples of tensors: what is made of it keeps form, order and batch."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchfra import tree
from torchfra.types import Gaussian


class Pair(NamedTuple):
    belief: Gaussian
    count: int
    rest: Tensor | None


def beliefs(*batch):
    generator = torch.Generator().manual_seed(0)
    return Gaussian(torch.randn(*batch, 3, generator=generator), torch.randn(*batch, 3, 3, generator=generator))


def test_a_map_keeps_the_form_and_leaves_what_is_no_tensor():
    doubled = tree.map_tensors(lambda x: 2 * x, Pair(beliefs(4), 7, None))
    assert isinstance(doubled, Pair)
    assert (doubled.count, doubled.rest) == (7, None)
    torch.testing.assert_close(doubled.belief.mean, 2 * beliefs(4).mean)


def test_leaves_and_form_make_the_tree_again():
    pair = Pair(beliefs(4), 7, torch.arange(3))
    again = tree.unflatten(pair, iter(tree.flatten(pair)))
    assert again.count == 7
    assert all(a is b for a, b in zip(tree.flatten(pair), tree.flatten(again), strict=True))


def test_steps_stacked_over_time_come_apart_again():
    steps = [beliefs(4)._replace(mean=torch.full((4, 3), float(k))) for k in range(5)]
    stacked = tree.stack(steps, 0)
    assert stacked.scale_tril.shape == (5, 4, 3, 3)
    for step, again in zip(steps, tree.unbind(stacked, 5), strict=True):
        torch.testing.assert_close(step, again)


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
def test_a_choice_by_track_is_a_choice_of_every_field(batch):
    mask = torch.arange(6).reshape(batch) % 2 == 0
    chosen = tree.where(mask, beliefs(*batch), tree.map_tensors(torch.zeros_like, beliefs(*batch)))
    torch.testing.assert_close(chosen.mean[mask], beliefs(*batch).mean[mask])
    assert (chosen.scale_tril[~mask] == 0).all()


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
@pytest.mark.parametrize("which", ["none", "some", "all"])
def test_what_is_computed_for_some_tracks_is_what_is_computed_for_all_and_chosen(batch, which):
    mask = {"none": torch.zeros(6), "some": torch.tensor([0, 1, 1, 0, 0, 1]), "all": torch.ones(6)}[which].reshape(
        batch
    )
    shared = torch.arange(3.0)  # of no batch

    def function(belief, vector):
        return Gaussian(belief.mean + vector, 3 * belief.scale_tril)

    default = beliefs(*batch)
    some = tree.where_needed(mask > 0, function, (beliefs(*batch), shared), default)
    torch.testing.assert_close(some, tree.where(mask > 0, function(beliefs(*batch), shared), default))


def test_a_dimension_goes_in_behind_the_batch_and_out_again():
    wide = tree.insert_batch_dimension(beliefs(2, 4))
    assert (wide.mean.shape, wide.scale_tril.shape) == ((2, 4, 1, 3), (2, 4, 1, 3, 3))
    torch.testing.assert_close(tree.remove_batch_dimension(wide), beliefs(2, 4))
    shared = Gaussian(beliefs(4).mean, torch.eye(3))
    assert tree.insert_batch_dimension(shared).scale_tril.shape == (3, 3)


def test_a_tuple_without_ranks_is_refused():
    with pytest.raises(TypeError, match="event_ranks, received Pair"):
        tree.insert_batch_dimension(Pair(beliefs(4), 7, torch.arange(3)))


def test_no_gradient_flows_through_a_detached_tree():
    x = torch.ones(2, 3, requires_grad=True)
    assert not tree.detach(Gaussian(x * 2, torch.eye(3))).mean.requires_grad


def test_what_is_said_one_step_late_is_the_same_with_room_behind_the_last_step_and_without() -> None:
    said, end = torch.arange(10.0).reshape(1, 5, 2), torch.tensor([[20.0, 21.0]])
    roomy = torch.cat([said, torch.full((1, 1, 2), torch.nan)], 1)
    without = tree.one_earlier(tree.Late(said), end, 1, 5)
    with_room = tree.one_earlier(tree.Late(roomy), end, 1, 5)
    assert torch.equal(without, torch.cat([said[:, 1:], end.unsqueeze(1)], 1))
    assert torch.equal(with_room, without)
    assert with_room.data_ptr() == roomy[:, 1:].data_ptr(), "expected a view of what the kernel wrote"
