"""A trainer over drawn batches."""

import torch
from torch import nn

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.trainer import Trainer


class Linear(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3, 4))
        self.bias = nn.Parameter(torch.zeros(3))
        self.fixed = nn.Parameter(torch.ones(3), requires_grad=False)


def batch(index):
    return torch.from_numpy(stream("t", 0, "x", index).standard_normal((8, 4))).float()


TRUTH = torch.arange(12.0).reshape(3, 4) / 12


def trainer(folder, schedule, facts="a", bad_at=-1, device="cpu"):
    model = Linear().to(device)
    truth = TRUTH.to(device)

    def loss(x, index):
        error = ((x @ model.weight.T + model.bias - x @ truth.T) ** 2).mean()
        return (error * float("nan") if index == bad_at else error), {
            "error": float(error.detach())
        }

    return Trainer(model, folder, schedule, batch, loss, {"data": facts})
