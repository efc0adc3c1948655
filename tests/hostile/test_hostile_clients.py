"""A seeded run of hostile byte streams against one server, which answers valid requests and keeps serving."""

import random
import socket

import pytest
from hostile.streams import ANSWER, PROTOCOLS, REQUEST, check, exchange, good_stream, hostile_stream
from testing.models import no_type_checker
from testing.serving import running

import pisigma

COUNT, SEED = 40, 0


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_stream_does_harm(protocol, repository):
    folder, rng, bad = repository / "models" / "kiro4", random.Random(SEED), []
    with running(folder) as server, no_type_checker():
        ik = pisigma.load(folder)
        port = server.json_port if protocol == "json" else server.binary_port
        for number in range(COUNT):
            stream = (
                good_stream(rng, protocol, ik, 3) if number % 10 == 0 else hostile_stream(rng, protocol, ik)
            )
            received, whole = exchange(rng, port, stream)
            if problem := check(protocol, stream, received, whole, ik):
                bad.append(f"{number}: {problem}")
    assert not bad, "\n".join(bad)


def test_the_check_notices_wrong_answers(repository):
    rng = random.Random(SEED)
    with running(repository / "models" / "kiro4") as server, no_type_checker():
        ik = pisigma.load(repository / "models" / "kiro4")
        first, second = (good_stream(rng, "binary", ik, 2) for _ in range(2))
        with (
            socket.create_connection(("127.0.0.1", server.binary_port), 10) as stream,
            stream.makefile("rb") as file,
        ):
            stream.sendall(first)
            answers = file.read(2 * ANSWER.size)
    assert check("binary", first, answers, True, ik) is None
    swapped = answers[ANSWER.size :] + answers[: ANSWER.size]
    assert "not to" in check("binary", first, swapped, True, ik)
    assert "were due" in check("binary", first, answers[: ANSWER.size], True, ik)
    renamed = first[:8] + second[8:16] + first[16:]
    assert "not to" in check("binary", renamed, answers, True, ik)
    moved = first[:24] + second[24 : REQUEST.size] + first[REQUEST.size :]
    assert "lead elsewhere" in check("binary", moved, answers, True, ik)
