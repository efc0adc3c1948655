"""Requests over OPC UA: a method for corrected joint values, and variables with the name, age and state of models."""

import asyncio
import contextlib
import functools
import json
import logging
import math
import os
import socket
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pisigma.deployment.serve.json_lines import JsonLines
from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ModelStatus, ServedModel, ServedModels
from pisigma.deployment.serve.protocol import tokens_match
from pisigma.deployment.serve.settings import ServeSettings, is_local
from pisigma.files.errors import OutputError, Place
from pisigma.files.input_file import read_input
from pisigma.files.output_file import write_atomically

if TYPE_CHECKING:
    import asyncua
    from asyncua.crypto.permission_rules import User

NAMESPACE = "urn:pisigma:server"
USER = "pisigma"
"""Name of the user whose password is the token of the server."""
_POLL_INTERVAL = 0.5
"""Time between two checks of which models are served [s]."""
_STATUS_INTERVAL = 10.0
"""Time after which the age and state of a model are determined again [s]."""
_CERTIFICATE, _KEY, _TRUSTED = "server_certificate.der", "server_key.pem", "trusted"
_CERTIFICATE_DAYS = 3650
_TEXTS = ("Name", "Sha256", "Day", "State", "Reason", "Joints", "Units")
"""Text variables of every model; AgeDays is a number instead."""


class OpcUa:
    """An OPC UA server in a separate thread.

    Without a token, only programs on this machine can connect, and no user name is needed. With a token, every client
    needs the user `USER`, whose password is the token, or a certificate in the folder `trusted`. If other machines can
    reach the server, all connections are signed and encrypted.

    Attributes:
        port: port of the server.
    """

    def __init__(self, models: ServedModels, metrics: Metrics, settings: ServeSettings) -> None:
        """Start listening.

        Raises:
            ImportError: asyncua is not installed.
            OutputError: the port is in use, a certificate cannot be used, or other machines can reach the server and
                there are no certificates.
        """
        try:
            import asyncua  # noqa: F401
        except ImportError as problem:
            raise ImportError(str(problem), name="asyncua") from None
        self._is_local = is_local(settings.host)
        if not self._is_local and settings.opcua_certificates is None:
            raise OutputError(
                f"other machines can reach '{settings.host}', so OPC UA must be encrypted",
                option="--opcua-certificates",
                remedy="give a folder for the certificates, or serve at 127.0.0.1",
            )
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # asyncua would report every refused client
        self._models, self._json, self._settings = models, JsonLines(models, metrics), settings
        self._uri, self._trusted = f"{NAMESPACE}:{socket.gethostname()}", frozenset[bytes]()
        if settings.opcua_certificates is not None:
            self._trusted = _trusted_certificates(settings.opcua_certificates)
            _make_own_certificate(settings.opcua_certificates, self._uri)
        self.port = settings.opcua_port or _free_port(settings.host)
        started: Future[asyncio.AbstractEventLoop] = Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve(started)), name="OPC UA", daemon=True
        )
        self._thread.start()
        try:
            self._loop = started.result()
        except OSError as problem:
            raise OutputError(
                f"port {self.port} of '{settings.host}' cannot be used by OPC UA ({problem.strerror})",
                value=self.port,
                option="--opcua-port",
                remedy="give a free port, or 0 for any",
            ) from None

    @property
    def is_running(self) -> bool:
        """Whether the thread is still answering."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """End the connections, from any thread."""
        if self.is_running:
            self._loop.call_soon_threadsafe(self._stopping.set)

    async def _serve(self, started: "Future[asyncio.AbstractEventLoop]") -> None:
        self._stopping = asyncio.Event()
        try:
            server = await self._server()
            index = await server.register_namespace(NAMESPACE)
            robots: list[_Robot] = []
            await self._look(server, index, robots)
            await server.start()
        except BaseException as problem:
            started.set_exception(problem)
            return
        started.set_result(asyncio.get_running_loop())
        while not self._stopping.is_set():
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), _POLL_INTERVAL)
            await self._look(server, index, robots)
        listener = server.bserver and server.bserver._server
        if listener is not None:
            listener.close()  # before the connections, because clients that reconnect at once would prevent the stop
        await server.stop()

    async def _server(self) -> "asyncua.Server":
        """Return a server that has not been started, with its certificates and the clients that it admits."""
        from asyncua import Server, ua

        folder = self._settings.opcua_certificates
        token = None if self._settings.token is None else self._settings.token.encode()
        server = Server(user_manager=_Admission(self._is_local and token is None, token, self._trusted))
        await server.init()
        host = self._settings.host
        server.set_endpoint(f"opc.tcp://{f'[{host}]' if ':' in host else host}:{self.port}")
        server.set_server_name("pisigma")
        await server.set_application_uri(self._uri)
        policies = [ua.SecurityPolicyType.NoSecurity] if self._is_local else []
        if folder is not None:
            try:
                await server.load_certificate(folder / _CERTIFICATE)
                await server.load_private_key(folder / _KEY)
            except ValueError as problem:
                raise _invalid_pair(folder, str(problem)) from None
            policies += [
                ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
                ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
            ]
        server.set_security_policy(policies)
        return server

    async def _look(self, server: "asyncua.Server", index: int, robots: "list[_Robot]") -> None:
        """Add objects of new models, and update the variables of all."""
        for number in range(len(self._models)):
            if number == len(robots):
                call, dof = functools.partial(self._call, number), len(self._models[number].ik.joints)
                robots.append(await _Robot.add(server, index, f"Model{number}", call, dof))
            await robots[number].update(self._models[number])

    async def _call(self, number: int, parent: Any, *arguments: Any) -> Any:
        """Answer `CorrectedJoints` with the handling of requests as lines of JSON."""
        from asyncua import ua

        if len(arguments) != 2:
            code = (
                ua.StatusCodes.BadArgumentsMissing
                if len(arguments) < 2
                else ua.StatusCodes.BadTooManyArguments
            )
            return ua.StatusCode(code)
        pose, near = (argument.Value for argument in arguments)
        model = self._models[number]
        none = [math.nan] * len(model.ik.joints)
        request = {"model": number, "pose": pose}
        if near and str(near) != str(none):
            request["near_deg" if model.joints_key == "q_deg" else "near"] = near
        reply = self._json.answer_message(json.dumps(request).encode())
        answer = json.loads(reply if isinstance(reply, bytes) else await asyncio.to_thread(reply))
        status = answer.get("status", "refused")
        values = {
            ua.VariantType.Double: answer.get("q_deg") or answer.get("q") or none,
            ua.VariantType.Boolean: status == "reached",
        }
        texts = status, answer.get("error") or answer.get("sentence") or "", answer.get("model", "")
        return [
            *(ua.Variant(value, kind, is_array=isinstance(value, list)) for kind, value in values.items()),
            *(ua.Variant(text, ua.VariantType.String) for text in texts),
        ]


class _Robot:
    """The object of one model: its method and variables."""

    def __init__(self, variables: "dict[str, asyncua.Node]") -> None:
        self._variables, self._sha256, self._next = variables, "", 0.0

    @staticmethod
    async def add(server: "asyncua.Server", index: int, name: str, call: Any, dof: int) -> "_Robot":
        """Add the object of a model with `dof` joints to the address space; NodeIds begin with the model's name."""
        from asyncua import ua

        owner = await server.nodes.objects.add_object(ua.NodeId(name, index), ua.QualifiedName(name, index))
        variables = {
            key: await owner.add_variable(
                ua.NodeId(f"{name}.{key}", index), ua.QualifiedName(key, index), "", ua.VariantType.String
            )
            for key in _TEXTS
        }
        variables["AgeDays"] = await owner.add_variable(
            ua.NodeId(f"{name}.AgeDays", index), ua.QualifiedName("AgeDays", index), 0, ua.VariantType.Int32
        )
        inputs = [
            _argument(
                "Pose",
                ua.ObjectIds.Double,
                "x, y, z [mm], roll, pitch, yaw [deg] of the tool in the frame of the measurements",
                6,
            ),
            _argument(
                "Near", ua.ObjectIds.Double, "joint values to stay close to [deg or mm]; NaN for none", dof
            ),
        ]
        outputs = [
            _argument("Joints", ua.ObjectIds.Double, "joint values [deg or mm]; NaN if there are none", dof),
            _argument("Reached", ua.ObjectIds.Boolean, "whether the robot may be moved to them"),
            _argument("Status", ua.ObjectIds.String, "status of the solution, or refused"),
            _argument("Sentence", ua.ObjectIds.String, "what the status means, or why it is refused"),
            _argument("Model", ua.ObjectIds.String, "the model that answered"),
        ]
        await owner.add_method(
            ua.NodeId(f"{name}.CorrectedJoints", index),
            ua.QualifiedName("CorrectedJoints", index),
            call,
            inputs,
            outputs,
        )
        return _Robot(variables)

    async def update(self, model: ServedModel) -> None:
        """Write the variables if there is a new model, or if age and state of the model may have changed."""
        from asyncua import ua

        if model.sha256 == self._sha256 and time.monotonic() < self._next:
            return
        status = await asyncio.to_thread(ModelStatus.of_model, model)
        texts = {
            "Name": status.model,
            "Sha256": status.sha256,
            "Day": status.day,
            "State": status.state,
            "Reason": status.reason,
            "Joints": ", ".join(model.ik.joints),
            "Units": ", ".join("deg" if is_revolute else "mm" for is_revolute in model.ik.revolute),
        }
        for name, text in texts.items():
            await self._variables[name].write_value(text, ua.VariantType.String)
        age = ua.DataValue(ua.Variant(status.age_days or 0, ua.VariantType.Int32))
        if status.age_days is None:
            age = ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNoData))
        await self._variables["AgeDays"].write_value(age)
        self._sha256, self._next = model.sha256, time.monotonic() + _STATUS_INTERVAL


def _argument(name: str, kind: int, meaning: str, length: int | None = None) -> "asyncua.ua.Argument":
    """Return the description of an argument: an array of a length, or a single value for the length None."""
    from asyncua import ua

    return ua.Argument(
        Name=name,
        DataType=ua.NodeId(kind),
        ValueRank=ua.ValueRank.Scalar if length is None else ua.ValueRank.OneDimension,
        ArrayDimensions=[] if length is None else [length],
        Description=ua.LocalizedText(meaning),
    )


class _Admission:
    """Rule that decides which clients are admitted."""

    def __init__(self, is_open: bool, token: bytes | None, trusted: frozenset[bytes]) -> None:
        """Store who is admitted: everybody, users with a token, and owners of certificates (DER)."""
        self._is_open, self._token, self._trusted = is_open, token, trusted

    def get_user(
        self,
        iserver: object,
        username: str | None = None,
        password: Any = None,
        certificate: bytes | None = None,
    ) -> "User | None":
        """Return the user of a client; None if the client is not admitted."""
        from asyncua.crypto.permission_rules import User, UserRole

        if username is not None and self._token is not None:
            secret = password.encode() if isinstance(password, str) else password
            is_admitted = username == USER and tokens_match(secret, self._token)
        else:
            is_admitted = self._is_open or (username is None and certificate in self._trusted)
        return User(role=UserRole.User, name=username or "") if is_admitted else None


def _trusted_certificates(folder: Path) -> frozenset[bytes]:
    """Read the certificates of clients (DER or PEM) in the folder `trusted`.

    Raises:
        OutputError: a file is not a certificate.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.serialization import Encoding

    found = set()
    for path in sorted((folder / _TRUSTED).glob("*")):
        content = read_input(path, OutputError)
        read = (
            x509.load_pem_x509_certificate if content.startswith(b"-----") else x509.load_der_x509_certificate
        )
        try:
            found.add(read(content).public_bytes(Encoding.DER))
        except ValueError:
            raise OutputError(
                expected="a DER or PEM certificate",
                at=Place(path),
                option="--opcua-certificates",
                remedy="replace or remove the file",
            ) from None
    return frozenset(found)


def _make_own_certificate(folder: Path, uri: str) -> None:
    """Write a key and a self-signed certificate of the server, unless the folder already has them.

    Raises:
        OutputError: the folder has only one of the two files, or they cannot be written.
    """
    from asyncua.crypto import cert_gen
    from cryptography import x509
    from cryptography.hazmat.primitives.serialization import Encoding
    from cryptography.x509.oid import ExtendedKeyUsageOID

    present = [name for name in (_CERTIFICATE, _KEY) if (folder / name).exists()]
    if len(present) == 1:
        raise _invalid_pair(folder, f"only {present[0]} exists")
    if present:
        return
    key, host = cert_gen.generate_private_key(), socket.gethostname()
    certificate = cert_gen.generate_self_signed_app_certificate(
        key,
        f"pisigma@{host}",
        {},
        [x509.UniformResourceIdentifier(uri), x509.DNSName(host)],
        [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH],
        _CERTIFICATE_DAYS,
    )
    try:
        (folder / _TRUSTED).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / _KEY, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(cert_gen.dump_private_key_as_pem(key))
    except OSError as problem:
        raise OutputError(
            f"the certificate cannot be written: {problem.strerror}",
            at=Place(folder),
            option="--opcua-certificates",
        ) from None
    write_atomically(folder / _CERTIFICATE, certificate.public_bytes(Encoding.DER))


def _invalid_pair(folder: Path, why: str) -> OutputError:
    return OutputError(
        f"expected {_CERTIFICATE} (DER) and its key {_KEY} (PEM): {why}",
        at=Place(folder),
        option="--opcua-certificates",
        remedy="give both files, or remove them to generate new ones",
    )


def _free_port(host: str) -> int:
    with socket.create_server(
        (host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET
    ) as listener:
        return int(listener.getsockname()[1])
