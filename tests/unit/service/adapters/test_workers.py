"""The worker pool: bounded, and no place is ever lost."""

import asyncio
import threading

import pytest

from service.adapters.workers import WorkerPool
from service.errors import Overloaded


def test_work_gives_its_result_or_its_error():
    async def scenario():
        pool = WorkerPool(1, 1)
        with pool.admit() as ticket:
            assert await ticket.run(lambda: 6 * 7) == 42
            with pytest.raises(ZeroDivisionError):
                await ticket.run(lambda: 1 // 0)
        pool.close()

    asyncio.run(scenario())


@pytest.mark.parametrize(("workers", "waiting"), [(1, 0), (1, 2), (3, 1)])
def test_more_than_the_places_is_refused(workers, waiting):
    pool = WorkerPool(workers, waiting)
    tickets = [pool.admit() for _ in range(workers + waiting)]
    for ticket in tickets:
        ticket.__enter__()
    assert pool.is_full()
    with pytest.raises(Overloaded), pool.admit():
        pass
    tickets[0].__exit__(None, None, None)
    with pool.admit():
        assert pool.is_full()


def test_a_place_is_anothers_while_its_client_takes_what_was_made():
    pool = WorkerPool(1, 0)
    with pool.admit() as slow:
        with slow.aside():
            assert not pool.is_full()
            with pool.admit():
                assert pool.is_full()
        assert pool.is_full()
    assert not pool.is_full()


def test_never_more_run_than_there_are_workers():
    async def scenario():
        pool, together, most = WorkerPool(2, 20), [0], [0]
        lock = threading.Lock()

        def work():
            with lock:
                together[0] += 1
                most[0] = max(most[0], together[0])
            with lock:
                together[0] -= 1

        async def one():
            with pool.admit() as ticket:
                await ticket.run(work)

        await asyncio.gather(*(one() for _ in range(20)))
        assert 1 <= most[0] <= 2
        assert (pool.running(), pool.waiting()) == (0, 0)

    asyncio.run(scenario())


def test_a_client_that_leaves_keeps_its_place_until_its_thread_is_done():
    async def scenario():
        pool, begun, gate = WorkerPool(1, 0), threading.Event(), threading.Event()

        def work():
            begun.set()
            gate.wait(30.0)

        async def client():
            with pool.admit() as ticket:
                await ticket.run(work)

        task = asyncio.create_task(client())
        await asyncio.to_thread(begun.wait, 30.0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert pool.is_full()
        gate.set()
        while pool.is_full():
            await asyncio.sleep(0.001)
        with pool.admit() as ticket:
            assert await ticket.run(lambda: "free") == "free"

    asyncio.run(scenario())


def test_work_that_nobody_waits_for_does_not_begin():
    async def scenario():
        pool, begun, gate, ran = WorkerPool(1, 1), threading.Event(), threading.Event(), []

        def hold():
            begun.set()
            gate.wait(30.0)

        async def client(work):
            with pool.admit() as ticket:
                await ticket.run(work)

        first = asyncio.create_task(client(hold))
        await asyncio.to_thread(begun.wait, 30.0)
        second = asyncio.create_task(client(lambda: ran.append(1)))
        await asyncio.sleep(0)
        assert (pool.running(), pool.waiting()) == (1, 1)
        second.cancel()
        with pytest.raises(asyncio.CancelledError):
            await second
        assert not pool.is_full()
        gate.set()
        await first
        with pool.admit() as ticket:
            await ticket.run(lambda: None)
        assert ran == []

    asyncio.run(scenario())
