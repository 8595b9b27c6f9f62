-- Rows as in `store/record.rs` (layout, JSON, CRC-32C) in `row`, beside copies of the fields that queries need.
-- Names that a client chooses may contain any character, also NUL, so they are bytes.
-- Rows that change often leave space in their pages: an update that changes no index then writes one page.

-- The clock of all leases: coordinators on several machines have clocks of their own.
CREATE FUNCTION now_ms() RETURNS bigint LANGUAGE sql VOLATILE
    AS $$ SELECT (extract(epoch FROM clock_timestamp()) * 1000)::bigint $$;

CREATE TABLE jobs (
    job_id text COLLATE "C" PRIMARY KEY,
    tenant text COLLATE "C" NOT NULL,
    state text NOT NULL,
    priority integer NOT NULL,
    max_parallel bigint NOT NULL,
    leased bigint NOT NULL,
    dataset text COLLATE "C",
    row bytea NOT NULL
) WITH (fillfactor = 50);
CREATE INDEX jobs_open ON jobs (tenant) WHERE state IN ('running', 'paused');
CREATE INDEX jobs_by_state ON jobs (state);
CREATE INDEX jobs_of_dataset ON jobs (tenant, dataset) WHERE dataset IS NOT NULL;

-- Queues fill and empty faster than the planner's statistics. So those who look for ready or leased tasks name
-- columns that only one index has, and no other plan is possible.
CREATE TABLE tasks (
    job_id text COLLATE "C" NOT NULL,
    stage smallint NOT NULL,
    part bigint NOT NULL,
    state text NOT NULL,
    not_before_ms bigint NOT NULL,
    method text NOT NULL,
    memory_bytes bigint NOT NULL,
    pace_ms double precision,
    row bytea NOT NULL,
    ready_job text COLLATE "C" GENERATED ALWAYS AS (CASE WHEN state = 'ready' THEN job_id END) STORED,
    leased_job text COLLATE "C" GENERATED ALWAYS AS (CASE WHEN state = 'leased' THEN job_id END) STORED,
    PRIMARY KEY (job_id, stage, part)
) WITH (fillfactor = 70);
CREATE INDEX tasks_ready ON tasks (ready_job, stage, part) WHERE ready_job IS NOT NULL;
CREATE INDEX tasks_leased ON tasks (leased_job, stage, part) WHERE leased_job IS NOT NULL;

CREATE TABLE events (
    job_id text COLLATE "C" NOT NULL,
    seq bigint NOT NULL,
    row bytea NOT NULL,
    PRIMARY KEY (job_id, seq)
);

-- Not indexed by deadline: every renewal changes that, and the sweeper reads the whole small table.
CREATE TABLE leases (
    job_id text COLLATE "C" NOT NULL,
    stage smallint NOT NULL,
    part bigint NOT NULL,
    fence bigint NOT NULL,
    attempt bigint NOT NULL,
    call bytea NOT NULL,
    deadline_ms bigint NOT NULL,
    still_since_ms bigint NOT NULL,
    iteration bigint,
    iterations bigint,
    gaussians bigint,
    loss real,
    speed real,
    held_out bytea,
    PRIMARY KEY (job_id, stage, part, fence)
) WITH (fillfactor = 30);
CREATE UNIQUE INDEX leases_by_call ON leases (call);

CREATE SEQUENCE fences;

-- At most one row.
CREATE TABLE deployment (
    is_this boolean PRIMARY KEY DEFAULT true CHECK (is_this),
    name text NOT NULL
);

CREATE TABLE requests (
    request bytea PRIMARY KEY,
    job_id text COLLATE "C" NOT NULL
);

CREATE TABLE worker_marks (
    incarnation bytea PRIMARY KEY,
    row bytea NOT NULL
);

CREATE TABLE quotas (
    tenant text COLLATE "C" PRIMARY KEY,
    max_parallel bigint NOT NULL,
    row bytea NOT NULL
);

CREATE TABLE tokens (
    token_id text COLLATE "C" PRIMARY KEY,
    row bytea NOT NULL
);

CREATE TABLE datasets (
    tenant text COLLATE "C" NOT NULL,
    dataset text COLLATE "C" NOT NULL,
    row bytea NOT NULL,
    PRIMARY KEY (tenant, dataset)
);
