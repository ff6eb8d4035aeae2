import hashlib

import pytest
import torch

from common.messages import MessageError, Version, WeightsBlob, decode, encode
from common.weights import pack, unpack

VERSION = Version(epoch=2, counter=7)
TENSORS = {
    "a.weight": torch.arange(6, dtype=torch.float32).reshape(2, 3) / 7,
    "b": torch.tensor([1, 2**40], dtype=torch.int64),
    "half": torch.tensor([0.1, 65504.0], dtype=torch.float16),
    "scalar": torch.tensor(0.2),
    "empty": torch.zeros(0, 3),
}


def test_tensors_arrive_to_the_bit_over_the_wire():
    message = decode(WeightsBlob, encode(pack(VERSION, TENSORS)))
    assert message.version == VERSION
    found = unpack(message)
    assert set(found) == set(TENSORS)
    for key, value in TENSORS.items():
        assert found[key].dtype == value.dtype
        assert torch.equal(found[key], value)


def test_transposed_and_trained_tensors_are_packed_by_value():
    parameter = torch.nn.Parameter(torch.arange(6.0).reshape(2, 3))
    found = unpack(pack(VERSION, {"t": parameter.T}))
    assert torch.equal(found["t"], parameter.detach().T)
    assert not found["t"].requires_grad


def test_tensors_that_share_memory_are_packed_both():
    shared = torch.arange(4.0)
    found = unpack(pack(VERSION, {"a": shared, "b": shared, "c": shared[:2]}))
    assert [found[key].tolist() for key in "abc"] == [[0, 1, 2, 3], [0, 1, 2, 3], [0, 1]]


def test_packed_weights_do_not_change_with_the_network():
    layer = torch.nn.Linear(2, 2)
    before = layer.weight.detach().clone()
    message = pack(VERSION, dict(layer.state_dict()))
    with torch.no_grad():
        layer.weight.add_(1)
    assert torch.equal(unpack(message)["weight"], before)


def test_a_flipped_bit_anywhere_in_the_blob_is_noticed():
    message = pack(VERSION, TENSORS)
    for position in range(0, len(message.blob), 17):
        blob = bytearray(message.blob)
        blob[position] ^= 1
        with pytest.raises(MessageError, match="checksum does not match"):
            unpack(message.model_copy(update={"blob": bytes(blob)}))


@pytest.mark.parametrize("blob", [b"", b"junk" * 10, b"\xff" * 8 + b"{}", (2**40).to_bytes(8, "little")])
def test_what_is_not_safetensors_is_refused_although_its_checksum_fits(blob):
    message = WeightsBlob(version=VERSION, sha256=hashlib.sha256(blob).hexdigest(), blob=blob)
    with pytest.raises(MessageError, match="not safetensors"):
        unpack(message)
