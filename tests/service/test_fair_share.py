"""Fair sharing between clients."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep, thread_time

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.floorplan import FloorPlan
from service.capacity.cpu_accounts import PROBES, CpuAccounts
from service.capacity.fair_share import FairQueue, FairSemaphore, Shares, max_per_client, with_headroom
from service.capacity.threads import BoundedReads, IdleCores, Threads, charge_until_now
from service.errors import StoreUnavailableError
from service.security.permissions import network_of
from service.storage.records import NewPlan, Original
from service.storage.store import Store
from tests.core.test_images import of_scans
from tests.service.conftest import FLAT, HALL, StartApp, assert_problem, localise, metric, upload, wait_for

WORST = "127.0.0.2"


@pytest.mark.parametrize(("limit", "alone"), [(1, 1), (2, 1), (3, 2), (4, 3), (6, 4), (32, 24), (64, 48)])
def test_single_client_gets_three_quarters(limit: int, alone: int) -> None:
    shares = Shares(limit)
    while shares.may_take("a"):
        shares.take("a")
    assert shares.held_by("a") == shares.in_use == alone == max_per_client(limit)
    assert shares.may_take("b") == (limit > 1)


@given(st.integers(1, 100))
def test_with_headroom_gives_one_client_its_count(count: int) -> None:
    shares = Shares(with_headroom(count))
    while shares.may_take("a"):
        shares.take("a")
    assert count <= shares.held_by("a") < shares.limit


@given(st.integers(1, 60), st.lists(st.tuples(st.sampled_from("abcd"), st.booleans()), max_size=300))
def test_idle_tenant_gets_a_slot(limit: int, steps: list[tuple[str, bool]]) -> None:
    shares = Shares(limit)
    for client, takes in steps:
        if takes and shares.may_take(client):
            shares.take(client)
        elif not takes and shares.held_by(client):
            shares.give_back(client)
        assert shares.in_use == sum(shares.held_by(client) for client in "abcd") <= limit
        assert shares.may_take("newcomer") == (shares.in_use < limit)


@given(st.integers(8, 200), st.integers(2, 4))
def test_greedy_clients_get_equal_shares(limit: int, clients: int) -> None:
    shares, names = Shares(limit), "abcd"[:clients]
    while shares.may_take("a"):
        shares.take("a")
    # The busiest client gives back a unit, and the permitted clients with the fewest units take units.
    for _ in range(20 * limit):
        shares.give_back(max(names, key=shares.held_by))
        for name in sorted(names, key=shares.held_by):
            if shares.may_take(name):
                shares.take(name)
    held = [shares.held_by(name) for name in names]
    assert max(held) - min(held) <= 2, held


@given(st.lists(st.sampled_from("abc"), max_size=40))
def test_queue_is_round_robin_and_oldest_first(clients: list[str]) -> None:
    queue: FairQueue[int] = FairQueue(CpuAccounts())
    for number, client in enumerate(clients):
        queue.append(client, number)
    served = [queue.take() for _ in clients]
    assert queue.take() is None
    for client in "abc":
        own = [found[1] for found in served if found is not None and found[0] == client]
        assert own == [number for number, other in enumerate(clients) if other == client]
    # A client with one item waits for at most one of every other client.
    for client in set(clients):
        first = next(place for place, found in enumerate(served) if found is not None and found[0] == client)
        assert first < len(set(clients))


def test_queue_drops_unwanted_items() -> None:
    queue: FairQueue[int] = FairQueue(CpuAccounts())
    for number in range(6):
        queue.append("ab"[number % 2], number)
    queue.append_first("a", 6)
    assert sorted(queue.drop(lambda number: number in (0, 1, 3, 5))) == [0, 1, 3, 5]
    assert len(queue) == 3
    assert [queue.take() for _ in range(4)] == [("a", 6), ("a", 2), ("a", 4), None]


def test_client_with_least_recent_cpu_time_is_first() -> None:
    now = [0.0]
    accounts = CpuAccounts(lambda: now[0])
    accounts.charge("a", 8.0)
    accounts.charge("b", 1.0)
    accounts.share = {"a": 1.0, "b": 1.0, "c": 1.0}.__getitem__

    def served() -> list[str]:
        queue: FairQueue[int] = FairQueue(accounts)
        for client in "aabbcc":
            queue.append(client, 0)
        return [found[0] for _ in range(6) if (found := queue.take()) is not None]

    assert served() == list("ccbbaa")
    now[0] = 20.0
    accounts.charge("c", 1.9)
    # Two half-lives later, 8 s count 2 s.
    assert accounts.recent_s("a") == pytest.approx(2.0)
    assert served() == list("bbccaa")
    # A weight of 2 counts them half again.
    accounts.share = {"a": 2.0, "b": 1.0, "c": 1.0}.__getitem__
    assert served() == list("bbaacc")
    assert accounts.totals() == {"a": 8.0, "b": 1.0, "c": 1.9}


def test_steps_of_a_coroutine_are_charged_without_other_tasks() -> None:
    accounts = CpuAccounts()

    async def scenario() -> str:
        async def work() -> str:
            await asyncio.sleep(0)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(asyncio.Event().wait(), 0.01)
            return "done"

        async def busy() -> None:
            begin = thread_time()
            while thread_time() - begin < 0.2:
                pass

        other = asyncio.create_task(busy())
        result = await accounts.charged_steps("a", work())
        await other
        return result

    assert asyncio.run(scenario()) == "done"
    assert 0.0 < accounts.total_s("a") < 0.2


def test_idle_cores_take_parts_of_a_call_for_its_client() -> None:
    accounts = CpuAccounts()
    permits = FairSemaphore(4, accounts)
    threads, idle_cores = Threads("calls", 4, accounts, permits), IdleCores(2, accounts, permits)

    def busy() -> str:
        begin = thread_time()
        while thread_time() - begin < 0.1:
            pass
        return threading.current_thread().name

    def call() -> str:
        helper = idle_cores.if_any()
        return helper.submit(busy).result() if helper else threading.current_thread().name

    async def scenario() -> tuple[str, str]:
        alone = await threads.run("a", call)
        async with permits.held("b"):
            return alone, await threads.run("a", call)

    alone, beside = asyncio.run(scenario())
    assert alone.startswith("idle-core")
    assert beside.startswith("calls"), "both cores are busy: with the call itself, and with that of another client"
    assert accounts.total_s("a") >= 0.1
    assert accounts.totals().keys() == {"a"}
    idle_cores.close()
    threads.close()


def test_client_rests_from_its_requests_beside_others() -> None:
    now = 0.0
    accounts = CpuAccounts(lambda: now)
    accounts.charge("busy", 0.1, rests=True)
    assert accounts.rest_s("busy") == 0.0, "nobody else is active"
    accounts.charge("busy", 0.1, rests=True)
    accounts.charge("busy", 9.0)
    accounts.charge("other", 0.001, rests=True)
    assert accounts.rest_s("busy") == pytest.approx(0.3), "three times what it used since it last rested"
    assert accounts.rest_s("other") == accounts.rest_s("new") == 0.0
    now = 0.2
    assert accounts.rest_s("busy") == pytest.approx(0.1), "all its requests rest together"
    now = 0.4
    assert accounts.rest_s("busy") == 0.0
    accounts.charge("busy", 60.0, rests=True)
    assert accounts.rest_s("busy") == pytest.approx(0.5), "rests are bounded"
    now = 9.0
    accounts.charge("busy", 0.1, rests=True)
    accounts.charge(PROBES, 0.1, rests=True)
    assert accounts.active() == {"busy"}
    assert accounts.rest_s("busy") == 0.0, "probes do not compete"
    assert accounts.rest_s(PROBES) == pytest.approx(0.3)


def test_queries_rest_after_refused_ones_beside_others() -> None:
    now = [0.0]
    accounts = CpuAccounts(lambda: now[0])
    accounts.charge("flood", 0.01)
    accounts.refuse("flood", 0.01)
    # Nobody else is active.
    assert accounts.refused_rest_s("flood") == 0.0
    accounts.charge("light", 0.01)
    for _ in range(2):
        accounts.refuse("flood", 0.01)
    assert accounts.refused_rest_s("flood") == pytest.approx(0.06)
    assert accounts.refused_rest_s("light") == 0.0
    # Accepted work leaves no such rest, and refusals leave none to other requests.
    assert accounts.rest_s("flood") == 0.0
    for _ in range(100):
        accounts.refuse("flood", 0.1)
    assert accounts.refused_rest_s("flood") == pytest.approx(0.5)
    now[0] = 0.6
    assert accounts.refused_rest_s("flood") == 0.0


def test_many_clients_do_not_fill_memory() -> None:
    accounts = CpuAccounts()
    for number in range(5000):
        accounts.charge(f"client {number}", 1.0)
    accounts.charge("busy", 5.0)
    for number in range(5000):
        accounts.charge(f"another {number}", 1.0)
    assert 3072 <= len(accounts.totals()) <= 4096
    assert accounts.total_s("busy") == 5.0


def test_client_leaves_cores_to_active_clients() -> None:
    async def scenario() -> None:
        now = [0.0]
        accounts = CpuAccounts(lambda: now[0])
        permits = FairSemaphore(8, accounts, cores=3)

        async def most(client: str) -> int:
            """Return the number of permits that the client gets."""
            held = 0
            with suppress(TimeoutError):
                while True:
                    await asyncio.wait_for(permits.acquire(client), 0.05)
                    held += 1
            return held

        alone = await most("a")
        # More than the cores, because pieces of work also wait for each other.
        assert alone == max_per_client(8)
        await permits.acquire("b")
        for _ in range(alone):
            permits.release("a")
        assert await most("a") == 2
        for _ in range(2):
            permits.release("a")
        # Another client is active while it uses CPU time, whatever for.
        accounts.charge("c", 0.1)
        assert await most("a") == 1
        now[0] = 2.0
        assert await most("a") == 1

    asyncio.run(scenario())


def test_permits_are_shared_fairly() -> None:
    async def scenario() -> list[str]:
        semaphore, order = FairSemaphore(2, CpuAccounts()), list[str]()

        async def take(client: str) -> None:
            await semaphore.acquire(client)
            order.append(client)
            await asyncio.sleep(0)
            semaphore.release(client)

        await semaphore.acquire("a")
        waiting = [asyncio.create_task(take(client)) for client in "aaab"]
        gone = asyncio.create_task(take("a"))
        await asyncio.sleep(0)
        gone.cancel()
        await asyncio.sleep(0.01)
        # The other one is not a's to take, so b had it at once.
        assert order == ["b"]
        semaphore.release("a")
        await asyncio.gather(*waiting)
        # Given up at the very moment when it came: it goes on to the next.
        await semaphore.acquire("a")
        late = asyncio.create_task(semaphore.acquire("a"))
        await asyncio.sleep(0)
        semaphore.release("a")
        late.cancel()
        await asyncio.gather(late, return_exceptions=True)
        await asyncio.wait_for(semaphore.acquire("a"), 1.0)
        return order

    assert asyncio.run(scenario()) == ["b", "a", "a", "a"]


def test_call_gives_way_only_to_clients_that_used_less() -> None:
    async def scenario() -> int:
        accounts, steps, ended = CpuAccounts(), {"a": 0, "b": 0}, threading.Event()
        turns, threads = FairSemaphore(1, accounts), Threads("test", 4, accounts)

        def compute(client: str, step_s: float) -> int:
            with turns.hold(client):
                while steps["b"] < 20 and not ended.is_set():
                    begin = thread_time()
                    while thread_time() - begin < step_s:
                        pass
                    steps[client] += 1
                    charge_until_now()
                    turns.give_way(client)
                ended.set()
            return steps["a"]

        large = asyncio.create_task(threads.run("a", compute, "a", 0.05))
        while (before := steps["a"]) < 3:
            await asyncio.sleep(0.01)
        try:
            return await threads.run("b", compute, "b", 0.001) - before
        finally:
            ended.set()
            await large
            threads.close()

    assert asyncio.run(scenario()) <= 3


def test_abandoned_thread_still_counts_for_its_client() -> None:
    async def scenario() -> None:
        threads, goes_on = Threads("test", 2), threading.Event()
        try:
            left = asyncio.create_task(threads.run("a", goes_on.wait, 20.0))
            await asyncio.sleep(0.05)
            left.cancel()
            second = asyncio.create_task(threads.run("a", lambda: "second"))
            assert await threads.run("b", lambda: "other") == "other"
            await asyncio.sleep(0.05)
            assert not second.done()
            goes_on.set()
            assert await second == "second"
        finally:
            goes_on.set()
            threads.close()

    asyncio.run(scenario())


def test_silent_reads_of_a_tenant_leave_a_thread_for_others() -> None:
    async def scenario() -> None:
        reads, goes_on = BoundedReads(threads=4, max_pending=20, wait_s=0.2), threading.Event()
        try:
            silent = [asyncio.create_task(reads.run("a", goes_on.wait, 20.0)) for _ in range(8)]
            await asyncio.sleep(0.05)
            for _ in range(5):
                assert await reads.run("b", lambda: "read") == "read"
            ended = await asyncio.gather(*silent, return_exceptions=True)
            assert [type(error) for error in ended] == [StoreUnavailableError] * 8
            goes_on.set()
            # Work on what was read has no timeout.
            assert await reads.process("a", lambda: sleep(0.4) or "parsed") == "parsed"
        finally:
            goes_on.set()
            reads.close()

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("address", "network"),
    [("10.0.0.1", "10.0.0.1"), ("::ffff:10.0.0.1", "10.0.0.1"), ("2001:db8::1:2", "2001:db8::/64"), ("x", "x")],
)
def test_addresses_of_a_network_count_as_one(address: str, network: str) -> None:
    assert network_of(address) == network


# The running service. Without keys, every client address is a client.


@contextmanager
def _sent(client: httpx.Client, head: str) -> Iterator[socket.socket]:
    """Send a request from another address without reading its answer."""
    address = (client.base_url.host, client.base_url.port or 80)
    with socket.socket() as connection:
        # Next to nothing of the answer fits in.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(10.0)
        connection.bind((WORST, 0))
        connection.connect(address)
        connection.sendall(head.encode("ascii"))
        yield connection


@pytest.mark.one_replica
def test_stalled_uploads_leave_slots_for_others(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    head = "POST /localise HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
    with start_app(tmp_path, max_pending_requests=8) as client, ExitStack() as attack:
        plan_id = upload(client)
        for _ in range(10):
            attack.enter_context(_sent(client, f"{head}Content-Length: 100000\r\n\r\n--b"))
        wait_for(lambda: metric(client, "lalaloc_requests_in_flight") == 6)
        assert localise(client, plan_id, sphere, refine="none").status_code == 200
        assert client.post("/floorplans", json=FLAT).status_code == 201
        with httpx.Client(base_url=client.base_url, transport=httpx.HTTPTransport(local_address=WORST)) as worst:
            problem = assert_problem(worst.post("/floorplans", json=FLAT), 503, "overloaded")
            expected = "6 of your requests are in progress, and the rest of the 8 slots is reserved for other tenants."
            assert expected in problem["detail"]


@pytest.mark.one_replica
def test_unread_answers_leave_slots_for_others(start_app: StartApp, tmp_path: Path, app_store: Store) -> None:
    # Larger than the socket buffers.
    content, plan_id = bytes(8 * 2**20), "a" * 32
    app_store.plans.add("default", plan_id, NewPlan(FloorPlan.from_dict(FLAT), Original(content)), limit=1)
    with start_app(tmp_path, max_reads=8) as client, ExitStack() as attack:
        path = f"/floorplans/{plan_id}/original"
        for _ in range(10):
            attack.enter_context(_sent(client, f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n"))
        # The limit of the address, which is more than the reads that run at a time.
        wait_for(lambda: metric(client, "lalaloc_reads_in_flight") == 6)
        sleep(0.2)
        assert client.get(path).content == content
        # The slot of an answer is free a moment after its last byte.
        wait_for(lambda: metric(client, "lalaloc_reads_in_flight") == 6)
        assert client.get("/floorplans").status_code == 200


@pytest.mark.one_replica
def test_streams_of_one_client_leave_slots_for_others(start_app: StartApp, tmp_path: Path) -> None:
    settings = {"grid_step_m": 0.1, "inline_grid_poses": 1, "max_grid_poses": 10**6}
    with start_app(tmp_path, max_streams=4, **settings) as client, ExitStack() as attack:
        path = f"/floorplans/{upload(client, HALL, wait=False)}"
        for _ in range(6):
            attack.enter_context(_sent(client, f"GET {path}/events HTTP/1.1\r\nHost: localhost\r\n\r\n"))
        wait_for(lambda: metric(client, "lalaloc_streams") == 3)
        with client.stream("GET", f"{path}/events") as events:
            assert events.status_code == 200
            assert next(events.iter_lines()).startswith("retry")
        assert client.delete(path).status_code == 204


@pytest.mark.slow
@pytest.mark.one_replica
def test_slow_picture_delays_no_other_tenant(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    # Its decoding takes most of a minute.
    slow = of_scans(14_000, 7_000, 400)
    with start_app(tmp_path, decode_workers=2, decode_stall_s=1.5, max_scans=10_000) as client, ExitStack() as attack:
        plan_id = upload(client)
        wait_for(lambda: client.get("/readyz").status_code == 200)
        request = httpx.Request(
            "POST", "http://localhost/localise", data={"floorplan_id": plan_id}, files={"photo": ("p", slow)}
        )
        lines = ["POST /localise HTTP/1.1", *(f"{name}: {value}" for name, value in request.headers.items())]
        for _ in range(3):
            connection = attack.enter_context(_sent(client, "\r\n".join([*lines, "", ""])))
            connection.sendall(request.read())
        wait_for(lambda: metric(client, "lalaloc_queries_in_work") >= 2)
        # Three pictures of 1.5 s and more: one after the other they would be in the way for 4.5 s.
        begin = monotonic()
        assert localise(client, plan_id, sphere, refine="none").status_code == 200
        assert metric(client, "lalaloc_queries_in_work") >= 2, f"all were done after {monotonic() - begin:.1f} s"
