"""Joint corrections for a KUKA controller over RSI: one answer in every interpolation cycle.

The controller computes the commanded joint values q (`ASPos`) with its nominal kinematics. The intended pose is
FK_nominal(q), and the answer is the absolute correction IK_corrected(FK_nominal(q)) - q. Whether `ASPos` contains the
correction of the last cycle makes only a second-order difference, the correction times its slope (about 1e-3 each),
because corrections are absolute and do not accumulate. Any fault ends the stream: without answers, the controller stops
RSI, and with it the robot, after `Timeout` cycles.
"""

import contextlib
import functools
import gc
import math
import re
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

import numpy as np

from pisigma.deployment.export.rsi import AXES, RsiAddress, check_six_axes
from pisigma.deployment.serve.metrics import KEPT_DURATIONS
from pisigma.files.errors import ModelError, OutputError, Phrase, RequestError
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kernels import arrays
from pisigma.robot.kinematics.status import Status

_CYCLE_MS = 4
"""Interpolation cycle of a controller, or a third of it (12 ms) [ms]; the time stamp counts milliseconds."""
_MAX_CYCLE_MS = 3 * _CYCLE_MS
_MAX_GAP = 10
"""Largest number of cycles from one answer to the next; packets in between were lost or late."""
_MAX_STEP_DEG = 0.05
"""Largest change of a correction per cycle [deg]: 12.5 deg/s at 4 ms, far more than motion along a path requires."""
RAMP_MS = 2000
"""Time in which the corrections rise from 0 at the start of a stream, and fall to 0 at its end [ms]."""
_SILENCE = 0.5
"""Time without packets after which the controller has ended the stream (RSI_OFF) [s]."""
_MAX_PACKET = 65535
_IPOC = re.compile(rb"<IPOC>\s*(\d+)\s*</IPOC>")
_SETPOINT = re.compile(rb"<ASPos\s([^>]*)>")
_VALUE = re.compile(rb'(A[1-6])\s*=\s*"([^"]*)"')
_SIX = struct.Struct("<6d")
_SUCCESS = (Status.REACHED, Status.OUTSIDE_DOMAIN)


@dataclass
class RsiCounts:
    """Statistics of a stream.

    Attributes:
        answered: number of cycles with an answer.
        unanswered: number of cycles without an answer, because packets were lost or late.
        ignored: number of packets from other senders.
        outside_domain: number of answers outside the domain of the model, where the correction is extrapolated.
        largest_correction_deg: largest absolute correction [deg].
        answer_seconds: times from packet to answer in the last cycles [s].
        slowest_answer: longest time from packet to answer [s].
    """

    answered: int = 0
    unanswered: int = 0
    ignored: int = 0
    outside_domain: int = 0
    largest_correction_deg: float = 0.0
    answer_seconds: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT_DURATIONS))
    slowest_answer: float = 0.0

    @property
    def sentence(self) -> str:
        """Summary of a stream."""
        p50, p99 = np.quantile(self.answer_seconds or [math.nan], [0.5, 0.99]) * 1e3
        return (
            f"RSI stream ended: {self.answered} cycles answered, {self.unanswered} lost or late, "
            f"{self.outside_domain} outside the domain, {self.ignored} packets of other senders; corrections at "
            f"most {self.largest_correction_deg:.4f} deg; answers after {p50:.3f} ms (median), {p99:.3f} ms (99 %), "
            f"{self.slowest_answer * 1e3:.3f} ms (maximum)."
        )


class RsiAnswers:
    """Answers of one stream.

    Attributes:
        counts: statistics so far.
        finished: whether the corrections have fallen to 0 after `ramp_down`.
    """

    def __init__(self, ik: CorrectedIK, sender: str, max_correction_deg: float) -> None:
        """Prepare a stream.

        Raises:
            ModelError: the model has no compiled kernels.
            OutputError: the robot does not have six revolute joints.
        """
        check_six_axes(ik.model)
        self._kernels, self._limit = _kernels(ik), max_correction_deg
        attributes = " ".join(f'{axis}="%.6f"' for axis in AXES)
        kind = quoteattr(sender).replace("%", "%%")
        self._form = f"<Sen Type={kind}><AKorr {attributes}/><IPOC>%d</IPOC></Sen>"
        self.counts, self.finished = RsiCounts(), False
        self._first: int | None = None
        self._last, self._cycle, self._leaving = 0, _MAX_CYCLE_MS, False
        self._weight, self._sent = 0.0, (0.0,) * len(AXES)

    def ramp_down(self) -> None:
        """Let the corrections fall to 0; `finished` is set when they have."""
        self._leaving = True
        self.finished = self.finished or self._first is None

    def answer(self, packet: bytes) -> bytes:
        """Return the answer to a packet.

        Raises:
            RequestError: the packet is damaged, its time stamp does not follow the last one, its pose cannot be
                reached, or a correction or its change is above the limit. Nothing must be sent from then on.
        """
        stamp, setpoint = _read(packet)
        cycles = self._cycles_since_last(stamp)
        wanted = self._correction(setpoint)
        self._weight += (-1 if self._leaving else 1) * cycles * self._cycle / RAMP_MS
        self._weight = min(max(self._weight, 0.0), 1.0)
        share = self._weight * self._weight * (3 - 2 * self._weight)  # without a jump of the speed
        sent = tuple(share * value for value in wanted)
        change = tuple((new - old) / max(cycles, 1) for new, old in zip(sent, self._sent, strict=True))
        if max(map(abs, change)) > _MAX_STEP_DEG:
            raise _fault("a change of the correction per cycle of at most", f"{_MAX_STEP_DEG} deg", change)
        self._sent = sent
        self.finished = self._leaving and self._weight == 0
        self.counts.answered += 1
        self.counts.largest_correction_deg = max(self.counts.largest_correction_deg, max(map(abs, sent)))
        return (self._form % (*sent, stamp)).encode()

    def _cycles_since_last(self, stamp: int) -> int:
        """Return the number of cycles since the last packet, 0 for the first one."""
        if self._first is None:
            self._first = self._last = stamp
            return 0
        elapsed = stamp - self._last
        if elapsed <= 0 or elapsed % _CYCLE_MS:
            raise RequestError(
                expected=f"an IPOC that is a multiple of {_CYCLE_MS} ms after {self._last}",
                value=stamp,
                option="IPOC",
                remedy="end RSI on the controller and start it again",
            )
        self._cycle, self._last = min(self._cycle, elapsed), stamp
        cycles = elapsed // self._cycle
        self.counts.unanswered += cycles - 1
        if cycles > _MAX_GAP:
            raise RequestError(
                expected=f"at most {_MAX_GAP - 1} cycles without an answer",
                value=cycles - 1,
                option="IPOC",
                remedy="check the network, and run nothing else on this computer",
            )
        return cycles

    def _correction(self, setpoint: list[float]) -> tuple[float, ...]:
        """Return the full correction [deg] at commanded joint values [deg]."""
        q = [math.radians(value) for value in setpoint]
        T = self._kernels.forward([q], arm=arrays.NOMINAL)[0]
        row = self._kernels.solve_packed(T.tobytes(), _SIX.pack(*q))
        status = Status(int(row[-2]))
        if status not in _SUCCESS:
            raise RequestError(
                f"the corrected joint values are {status.name.lower()}: {status.sentence}",
                value=setpoint,
                option="ASPos",
                remedy="move the program away from this pose",
            )
        self.counts.outside_domain += status == Status.OUTSIDE_DOMAIN
        correction = tuple(math.degrees(new) - old for new, old in zip(row[:6], setpoint, strict=True))
        if not max(map(abs, correction)) <= self._limit:
            raise _fault("corrections of at most", f"{self._limit:g} deg", correction)
        return correction


def _kernels(ik: CorrectedIK) -> CompiledIK:
    """Return the kernels of a model after a first solution, which compiles whatever is missing."""
    if ik.compiled is None or ik.controller_solver is not None:
        raise ModelError(
            f"model '{ik.name}' has no compiled form, so it cannot answer within a cycle",
            option="--rsi",
            remedy="choose --format targets",
        )
    ik.compiled.forward(np.zeros((1, len(AXES))), arm=arrays.NOMINAL)
    ik.compiled.solve_packed(np.eye(4).tobytes(), _SIX.pack(*[0.0] * len(AXES)))
    return ik.compiled


def _fault(expected: str, limit: str, values: tuple[float, ...]) -> RequestError:
    return RequestError(
        expected=f"{expected} {limit}",
        value=Phrase(", ".join(f"{axis} {value:.4f}" for axis, value in zip(AXES, values, strict=True))),
        option="AKorr",
        remedy="check that the joints of the controller have the zeros and directions of the robot description, and "
        "avoid singularities",
    )


def _read(packet: bytes) -> tuple[int, list[float]]:
    """Return the time stamp [ms] and the commanded joint values [deg] of a packet."""
    stamp, setpoint = _IPOC.search(packet), _SETPOINT.search(packet)
    if stamp is not None and setpoint is not None:
        with contextlib.suppress(ValueError):
            values = {name: float(text) for name, text in _VALUE.findall(setpoint[1])}
            if len(values) == len(AXES) and all(map(math.isfinite, values.values())):
                return int(stamp[1]), [values[axis.encode()] for axis in AXES]
    raise RequestError(
        expected="a packet with IPOC and ASPos with six finite values A1 to A6",
        value=packet[:200].decode(errors="replace"),
        option="ASPos",
        remedy="use the file of pisigma export --format rsi as the configuration of the ETHERNET object",
    )


class RsiServer:
    """Server that answers streams, one after the other, until it is stopped.

    Attributes:
        port: UDP port at which it receives.
    """

    def __init__(self, ik: CorrectedIK, address: RsiAddress, max_correction_deg: float) -> None:
        """Start listening; see `RsiAnswers`.

        Raises:
            OutputError: the address cannot be used.
        """
        self._begin = functools.partial(RsiAnswers, ik, address.sender, max_correction_deg)
        self._answers, self._stops = self._begin(), 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((address.host, address.port))
        except OSError as problem:
            self._socket.close()
            raise OutputError(
                f"{address.host}:{address.port} cannot be used ({problem.strerror})",
                value=f"{address.host}:{address.port}",
                option="--rsi",
                remedy="set IP_NUMBER and PORT in the file to an address of this machine and a free port",
            ) from None
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def stop(self) -> None:
        """Let `run` end after the corrections have fallen to 0, or immediately if called a second time."""
        self._stops += 1
        self._answers.ramp_down()

    def run(self, report: Callable[[str], None]) -> None:
        """Answer until `stop` is called.

        Args:
            report: function that is called with a summary at the end of a stream.

        Raises:
            RequestError: see `RsiAnswers.answer`; the controller then stops RSI.
        """
        gc.collect()
        gc.freeze()
        gc.disable()  # it would take longer than a cycle
        try:
            while not (self._stops and self._answers.finished) and self._stops < 2:
                self._stream(report)
        finally:
            gc.enable()
            gc.unfreeze()
            self._socket.close()

    def _stream(self, report: Callable[[str], None]) -> None:
        """Answer one stream of one controller."""
        answers, controller = self._answers, None
        counts = answers.counts
        try:
            while not answers.finished and self._stops < 2:
                found = self._newest(controller, counts)
                if found is None:
                    break
                packet, sender, began = found
                controller = sender[0]
                self._socket.sendto(answers.answer(packet), sender)
                counts.answer_seconds.append(time.perf_counter() - began)
                counts.slowest_answer = max(counts.slowest_answer, counts.answer_seconds[-1])
        finally:
            if counts.answered:
                report(counts.sentence)
        if not answers.finished:
            self._answers = self._begin()
        if self._stops:
            self._answers.ramp_down()

    def _newest(
        self, controller: str | None, counts: RsiCounts
    ) -> tuple[bytes, tuple[str, int], float] | None:
        """Wait for a packet of the controller; after a delay, only the newest of several can be answered in time.

        Args:
            controller: IP address of the controller; None for any address.
            counts: statistics of the stream.

        Returns:
            The packet, its sender, and the time at which it was noticed; None if the controller is silent.
        """
        found = None
        while found is None:
            if not select.select([self._socket], [], [], _SILENCE)[0]:
                return None
            began = time.perf_counter()
            with contextlib.suppress(BlockingIOError):
                while True:
                    packet, sender = self._socket.recvfrom(_MAX_PACKET)
                    if controller in (None, sender[0]):
                        found, controller = (packet, sender, began), sender[0]
                    else:
                        counts.ignored += 1
        return found
