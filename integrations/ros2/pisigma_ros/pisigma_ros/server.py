"""Connections to `pisigma serve`: binary frames for poses, and lines of JSON in a background thread."""

import threading
from xml.etree import ElementTree

from pisigma_ros.pisigma_client import FrameClient, JsonClient

URDF_TIMEOUT = 60.0
"""Maximum time to wait for the first URDF of a model, which the server has to create [s]."""
FRAMES, TIPS = ("calibrated_frame", "base_link"), ("calibrated_tool", "tool0")
"""Candidate links of a calibrated URDF for the frame of the poses and for the tool; the first existing one is used."""


class Server:
    """Corrected joint values from a server, and its information about a model.

    Attributes:
        problem: Why the server did not answer last; empty if it did.
        status: Name, SHA-256, age and state of the model, as the server states them.
        joints: Names of the joints of the model.
        urdf: URDF of the calibrated robot; empty if a URDF cannot describe it.
    """

    def __init__(self, host, port, json_port, token=None, model=0, timeout=0.5):
        """Connect, and request the model and its URDF; raise OSError or RuntimeError if this is not possible."""
        self._address, self._json_address = (
            (port, host, token, timeout),
            (json_port, host, token, URDF_TIMEOUT),
        )
        self._model, self._lines = model, None
        self._frames = FrameClient(*self._address)
        self.problem, self.status, self.joints, self.urdf = "", {}, [], ""
        self._ask()
        self._ended = threading.Event()

    def solve(self, *arguments):
        """See `FrameClient.solve`; after a failure, the next request opens a new connection."""
        if self._frames is None:
            self._frames = FrameClient(*self._address)
        try:
            return self._frames.solve(*arguments)
        except OSError:
            self._frames.close()
            self._frames = None
            raise

    def follow(self, period):
        """Request the model every `period` seconds in a background thread."""
        threading.Thread(target=self._follow, args=(period,), daemon=True).start()

    def close(self):
        """End the connections and the thread."""
        self._ended.set()
        for client in (self._frames, self._lines):
            if client is not None:
                client.close()

    @property
    def links(self):
        """Names of the links of the URDF that are the frame of the poses and the tool; "" without a URDF."""
        links = {
            link.get("name") for link in ElementTree.fromstring(self.urdf or "<robot/>").iterfind("link")
        }
        return tuple(next((name for name in names if name in links), "") for names in (FRAMES, TIPS))

    def _follow(self, period):
        while not self._ended.wait(period):
            try:
                self._ask()
                self.problem = ""
            except (OSError, RuntimeError, ValueError) as problem:
                if self._lines is not None:
                    self._lines.close()
                self._lines, self.problem = None, str(problem)

    def _ask(self):
        if self._lines is None:
            self._lines = JsonClient(*self._json_address)
        status = self._lines.ask(ask="status", model=self._model)
        if status["sha256"] != self.status.get("sha256"):
            self.joints = self._lines.ask(ask="models")["models"][self._model]["joints"]
            try:
                self.urdf = self._lines.ask(ask="urdf", model=self._model)["urdf"]
            except RuntimeError:
                self.urdf = ""
        self.status = {key: value for key, value in status.items() if key != "id"}
