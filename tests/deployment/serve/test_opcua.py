"""OPC UA: calls, variables and admission, driven by the client of asyncua."""

import asyncio
import math
from dataclasses import replace

import pytest
from testing.cell_models import FIRST, SECOND, cell_of_two_models, put_into_use
from testing.closeness import assert_close
from testing.refusals import refused
from testing.serving import json_client, running

from pisigma.deployment.serve.models import ServedModels
from pisigma.deployment.serve.opcua import NAMESPACE, USER
from pisigma.deployment.serve.server import Server
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.files.errors import OutputError

asyncua = pytest.importorskip("asyncua", reason="asyncua is not installed")
cert_gen = pytest.importorskip("asyncua.crypto.cert_gen")
oid = pytest.importorskip("cryptography.x509.oid")
policies = pytest.importorskip("asyncua.crypto.security_policies")

POSE = [800.0, 200.0, 600.0, 10.0, -80.0, 170.0]
LOCAL = ServeSettings(opcua=True, opcua_port=0)
REFUSALS = (asyncua.ua.UaError, ConnectionError, TimeoutError)


class Robot:
    """The object of the first model, for a connected client."""

    def __init__(self, client):
        self.client = client

    def node(self, name):
        return self.client.get_node(f"ns=2;s=Model0.{name}")

    async def joints(self, *arguments):
        values = [
            asyncua.ua.Variant(list(one), asyncua.ua.VariantType.Double, is_array=True) for one in arguments
        ]
        owner = self.client.get_node("ns=2;s=Model0")
        return await owner.call_method(self.node("CorrectedJoints"), *values)


def _client(server, **options):
    return asyncua.Client(f"opc.tcp://127.0.0.1:{server.opcua.port}", timeout=10, **options)


async def _check_calls(robot, lines):
    for near in ([], [math.nan] * 6, [5.0] * 6):
        q, *others = await robot.joints(POSE, near)
        stated = {"near_deg": near} if near == [5.0] * 6 else {}
        assert_close(q, lines.ask(pose=POSE, **stated)["q_deg"], atol=0)
        assert others == [True, "reached", "", FIRST]
    mixed = [math.nan, *[1.0] * 5]
    for pose, near, status in (
        (POSE[:3], [], "refused"),
        ([*POSE[:5], math.nan], [], "refused"),
        (POSE, [1.0] * 5, "refused"),
        (POSE, mixed, "refused"),
        ([9e4, *POSE[1:]], [], "unreachable"),
    ):
        q, *others = await robot.joints(pose, near)
        assert others[:2] == [False, status]
        assert len(q) == 6
        assert all(map(math.isnan, q))
    for arguments in ((POSE,), (POSE, [], [])):
        with pytest.raises(asyncua.ua.UaStatusCodeError):
            await robot.joints(*arguments)
    status = lines.ask(ask="status")
    assert await robot.node("Day").read_value() == status["day"] == "2026-01-10"
    assert await robot.node("State").read_value() == status["state"]
    assert await robot.node("AgeDays").read_value() == status["age_days"] > 0
    with pytest.raises(asyncua.ua.UaStatusCodeError):
        await robot.node("Name").write_value("other")


def test_clients_follow_the_model_in_use(tmp_path):
    cell, names = cell_of_two_models(tmp_path / "cell"), asyncio.Queue()

    class Changes:
        def datachange_notification(self, node, value, data):
            names.put_nowait(value)

    async def check(server, lines):
        async with _client(server, auto_reconnect=True, reconnect_max_delay=0.1) as client:
            robot = Robot(client)
            assert await client.get_namespace_index(NAMESPACE) == 2
            subscription = await client.create_subscription(20, Changes())
            await subscription.subscribe_data_change(robot.node("Name"))
            assert await asyncio.wait_for(names.get(), 30) == FIRST
            await _check_calls(robot, lines)
            put_into_use(cell, SECOND)
            assert lines.ask(ask="reload")["problems"] == []
            assert await asyncio.wait_for(names.get(), 30) == SECOND
            assert (await robot.joints(POSE, []))[4] == SECOND
            server.stop()  # ends although the client connects again and again
            while server.opcua.is_running:
                await asyncio.sleep(0.05)

    with running(cell=cell.folder, settings=LOCAL) as server, json_client(server) as lines:
        asyncio.run(check(server, lines))


def test_clients_of_other_machines_need_a_user_or_a_certificate_and_encryption(repository, tmp_path):
    folder, model = tmp_path / "certificates", repository / "models" / "kiro4"
    (folder / "trusted").mkdir(parents=True)
    settings = replace(LOCAL, host="0.0.0.0", token="secret")
    with refused(OutputError, option="--opcua-certificates"):
        Server(ServedModels([model]), settings)

    async def make_certificate(name):
        files = tmp_path / f"{name}.pem", tmp_path / f"{name}.der"
        usage = [oid.ExtendedKeyUsageOID.CLIENT_AUTH]
        await cert_gen.setup_self_signed_certificate(*files, "urn:test", "test", usage, {})
        return files

    async def ask(server, certificate, user=None, password=None):
        client = _client(server)
        if certificate is not None:
            key, own = certificate
            client.application_uri = "urn:test"
            await client.set_security(policies.SecurityPolicyBasic256Sha256, own, key)
        if user is not None:
            client.set_user(user)
            client.set_password(password)
        async with client:
            return (await Robot(client).joints(POSE, []))[2]

    async def check(server, known, unknown):
        admitted = (known,), (known, USER, "secret"), (unknown, USER, "secret")
        denied = (known, USER, "wrong"), (unknown, "admin", "secret")
        for arguments in admitted:
            assert await ask(server, *arguments) == "reached"
        for arguments in (*denied, (unknown,), (None,), (None, USER, "secret")):
            with pytest.raises(REFUSALS):
                await ask(server, *arguments)

    known, unknown = (asyncio.run(make_certificate(name)) for name in ("known", "unknown"))
    (folder / "trusted" / "client.der").write_bytes(known[1].read_bytes())
    with running(model, settings=replace(settings, opcua_certificates=folder)) as server:
        asyncio.run(check(server, known, unknown))
    assert (folder / "server_key.pem").stat().st_mode & 0o077 == 0


def test_what_cannot_be_served_over_opcua_is_refused(repository, tmp_path):
    models = ServedModels([repository / "models" / "kiro4"])
    (tmp_path / "file").write_text("")
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "server_key.pem").write_text("key")
    (tmp_path / "trusted").mkdir()
    (tmp_path / "trusted" / "damaged.der").write_bytes(b"damaged")
    for folder, file in (("file", "file"), ("one", "one"), (".", "damaged.der")):
        with refused(OutputError, file=file, option="--opcua-certificates"):
            Server(models, replace(LOCAL, opcua_certificates=tmp_path / folder))
