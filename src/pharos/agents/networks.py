"""Feature extractors: one for vectors, one for images, with as many features."""

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from pharos.agents.batched.runs import NATURE_PIXELS


class SmallMLP(BaseFeaturesExtractor):
    """One hidden layer over the flattened observation."""

    def __init__(self, observation_space: spaces.Space, features_dim: int = 128):
        super().__init__(observation_space, features_dim)
        size = int(spaces.utils.flatdim(observation_space))
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(size, features_dim), nn.ReLU())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(N, ...) -> (N, features)."""
        return self.layers(observations)


class SmallCNN(BaseFeaturesExtractor):
    """16 filters of 3 x 3, stride 1 (MinAtar). From 36 pixels on, the three convolutions of Mnih et al. (2015)."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128):
        super().__init__(observation_space, features_dim)
        channels, height, width = observation_space.shape
        if min(height, width) < NATURE_PIXELS:
            convolutions = [nn.Conv2d(channels, 16, 3, padding=1), nn.ReLU()]
        else:
            convolutions = [
                nn.Conv2d(channels, 32, 8, stride=4),
                nn.ReLU(),
                nn.Conv2d(32, 64, 4, stride=2),
                nn.ReLU(),
                nn.Conv2d(64, 64, 3),
                nn.ReLU(),
            ]
        self.convolutions = nn.Sequential(*convolutions, nn.Flatten())
        with torch.no_grad():
            size = self.convolutions(torch.zeros(1, channels, height, width)).shape[1]
        self.layers = nn.Sequential(self.convolutions, nn.Linear(size, features_dim), nn.ReLU())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(N, C, H, W) in [0, 1] -> (N, features)."""
        return self.layers(observations)
