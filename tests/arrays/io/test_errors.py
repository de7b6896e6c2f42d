"""A file is blamed for what the library refuses, never for what NumPy says."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.io.errors import InputError, naming


class TestNaming:
    @pytest.mark.parametrize("sentence", ["Input noise_T must be positive.", "Inputs a and b must differ."])
    def test_own_sentences_get_the_name(self, sentence: str) -> None:
        with pytest.raises(InputError, match=r"^log\.csv: (noise_T|a and b) must"), naming("log.csv"):
            raise ValueError(sentence)

    def test_the_argument_at_fault_is_named(self) -> None:
        with pytest.raises(InputError, match=r"^array\.toml: array must"), naming("log.csv", array="array.toml"):
            raise ValueError("Input array must have two sensors.")

    def test_others_stay_what_they_are(self) -> None:
        with pytest.raises(np.linalg.LinAlgError, match=r"^Singular matrix$"), naming("log.csv"):
            np.linalg.inv(np.zeros((2, 2)))
        with pytest.raises(ValueError, match="must have the same shape") as raised, naming("log.csv"):
            np.stack([np.zeros(2), np.zeros(3)])
        assert not isinstance(raised.value, InputError)
