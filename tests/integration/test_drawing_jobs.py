"""Jobs of drawings among archives, asked about over HTTP."""

from service.adapters.jobs.worker import running_worker
from service.job_ports import JobKind
from service.jobs.worker import worker_options
from service.pacs_ports import DRAWING_JOB
from tests.job_parts import ended
from tests.service_parts import app_for, problem, running


def test_what_was_given_back_to_archives_is_not_to_be_had_here(tmp_path):
    app = app_for(tmp_path)
    with running(app) as client:
        services = app.state.services
        identifier = services.jobs.new_id(DRAWING_JOB)
        kind = JobKind(DRAWING_JOB, lambda _run, _argument: {"stored": 6}, {})
        with running_worker([kind], worker_options(services.settings, 0)):
            services.jobs.enqueue(DRAWING_JOB, {"object": identifier}, identifier)
            assert ended(client, f"/v1/jobs/{identifier}")["state"] == "done"
        told = problem(client.get(f"/v1/jobs/{identifier}/result"), 404)
        assert "archives" in told["detail"]
