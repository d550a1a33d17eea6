"""Active sampling: the network learns where errors are, and its pixels are the worst of their candidates."""

from __future__ import annotations

import torch

from stages.fitting.active import Uncertainty, most_uncertain
from stages.fitting.batches import step_generator
from stages.fitting.surface import surface_points
from stages.fitting.trainer import Trainer
from tests.numerics.analytic_scene import model_of, scene, sphere, tiny_settings


def test_it_learns_where_and_when_errors_are() -> None:
    generator = torch.Generator().manual_seed(0)
    net = Uncertainty(2, 3, generator)
    optimiser = torch.optim.Adam(net.parameters(), lr=5e-3)

    def truth(video: torch.Tensor, time: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
        centre = 0.5 + 0.3 * time[:, None] * (1 - 2 * video[:, None])  # a spot that moves, the other way in clip 1
        return torch.exp(-(xy[..., 0] - centre).square() / 0.02)

    for _ in range(250):
        video = torch.randint(2, (16,), generator=generator)
        time = torch.rand(16, generator=generator) * 2 - 1
        xy = torch.rand(16, 32, 2, generator=generator)
        loss = (net(video, time, xy) - truth(video, time, xy)).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    video, time = torch.tensor([0, 1, 0]), torch.tensor([0.7, 0.7, -0.5])
    xy = torch.rand(3, 400, 2, generator=generator)
    expected = net(video, time, xy).detach()
    pick = most_uncertain(expected, 40)
    found = truth(video, time, xy)
    assert (found.gather(1, pick).mean(1) > 2 * found.mean(1)).all()


def test_active_pixels_are_the_worst_of_four_times_as_many() -> None:
    seen = scene(sphere(0.5), frames=4)
    settings = tiny_settings(iterations=4, active_share=0.5, active_from=0.0)
    trainer = Trainer(model_of(seen, lambda x: x.norm(dim=-1) - 0.45), seen.observations, settings)
    assert trainer.uncertainty is not None and len(surface_points(trainer.model, 16)) > 0
    with torch.no_grad():
        for layer in trainer.uncertainty.layers[:-1]:
            layer.weight.zero_()
            layer.bias.zero_()
        first, last = trainer.uncertainty.layers[0], trainer.uncertainty.layers[-1]
        first.weight[0, 0] = 1.0  # passes on 2 x - 1 where positive
        first.bias[0] = 1.0
        trainer.uncertainty.layers[1].weight[0, 0] = 1.0
        last.weight.zero_()
        last.weight[0, 0] = 1.0
    batch = trainer._draw(step_generator(0, 5))
    size = torch.tensor([(v.width, v.height) for v in seen.videos])[trainer.model.video_idx[batch.frame_idx]]
    x = batch.pixels[..., 0] / size[:, :1]
    assert batch.pixels.shape == (4, 24, 2)
    assert (x[:, 12:].mean(1) > x[:, :12].mean(1) + 0.03).all()  # the rightmost pixels
