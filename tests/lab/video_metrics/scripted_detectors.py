"""Made-up detectors as TorchScript programs."""

import torch


class BoxDetector(torch.nn.Module):
    """Finds a box as far to the side as the image is bright, or nothing in a black one."""

    def forward(
        self, image: torch.Tensor, K: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        count = int((image.mean() > 0).item())
        box = torch.tensor([[0.0, 0.0, 10.0, 4.0, 2.0, 0.01, 0.0]])
        box[0, 0] = 4 * image.mean()
        return box[:count], torch.ones(count), torch.zeros(count, dtype=torch.int64)


class LaneDetector(torch.nn.Module):
    """Finds a straight lane as far to the side as the image is bright."""

    def forward(
        self, image: torch.Tensor, K: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        ahead = torch.linspace(3.0, 80.0, 40)
        points = torch.stack([image.mean() * torch.ones(40), ahead, torch.zeros(40)], dim=-1)[None]
        return points, torch.ones(1, 40), torch.ones(1)


def save_script(detector, path):
    """Export a detector as a user does."""
    torch.jit.script(detector).save(str(path))
