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

-- The coordinators that use this database, each with a name that is new in every process.
CREATE TABLE members (
    member text PRIMARY KEY,
    seen_ms bigint NOT NULL
) WITH (fillfactor = 30);

-- Workers that have called any of them lately.
CREATE TABLE workers (
    incarnation text COLLATE "C" PRIMARY KEY,
    owner text NOT NULL,
    seen_ms bigint NOT NULL,
    registered_ms bigint NOT NULL,
    row bytea NOT NULL
) WITH (fillfactor = 50);

-- Whether a coordinator has reported itself lately. It does so every second.
CREATE FUNCTION is_member(text) RETURNS boolean LANGUAGE sql STABLE
    AS $$ SELECT EXISTS (SELECT 1 FROM members WHERE member = $1 AND seen_ms > now_ms() - 30000) $$;

-- The blobs of a bucket. While `going_until_ms` is set, garbage collection is deleting the object.
CREATE TABLE blobs (
    tenant text COLLATE "C" NOT NULL,
    digest bytea NOT NULL,
    bytes bigint NOT NULL,
    used_ms bigint NOT NULL,
    going_until_ms bigint,
    PRIMARY KEY (tenant, digest)
) WITH (fillfactor = 90);

-- Uploads into a bucket that are not complete. They count all declared bytes while a stream writes, else the
-- bytes that have arrived.
CREATE TABLE uploads (
    tenant text COLLATE "C" NOT NULL,
    digest bytea NOT NULL,
    bytes bigint NOT NULL,
    member text NOT NULL,
    is_written boolean NOT NULL,
    changed_ms bigint NOT NULL,
    PRIMARY KEY (tenant, digest)
) WITH (fillfactor = 70);

-- Tenants whose blobs are all in `blobs`.
CREATE TABLE filled_ledgers (
    tenant text COLLATE "C" PRIMARY KEY
);

-- Sums of `blobs` and `uploads`, by the first hex digit of the digest.
CREATE TABLE blob_bytes (
    tenant text COLLATE "C" NOT NULL,
    part smallint NOT NULL,
    bytes bigint NOT NULL,
    PRIMARY KEY (tenant, part)
) WITH (fillfactor = 30);

CREATE FUNCTION count_blob_bytes() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    one record;
    more bigint := 0;
BEGIN
    IF TG_OP = 'DELETE' THEN one := OLD; ELSE one := NEW; END IF;
    IF TG_OP <> 'DELETE' THEN more := more + NEW.bytes; END IF;
    IF TG_OP <> 'INSERT' THEN more := more - OLD.bytes; END IF;
    IF more <> 0 THEN
        INSERT INTO blob_bytes AS sums VALUES (one.tenant, get_byte(one.digest, 0) / 16, more)
            ON CONFLICT (tenant, part) DO UPDATE SET bytes = sums.bytes + more;
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER count_bytes AFTER INSERT OR DELETE OR UPDATE OF bytes ON blobs
    FOR EACH ROW EXECUTE FUNCTION count_blob_bytes();
CREATE TRIGGER count_bytes AFTER INSERT OR DELETE OR UPDATE OF bytes ON uploads
    FOR EACH ROW EXECUTE FUNCTION count_blob_bytes();

-- An append of log lines locks the row of its job here until the commit, so that their numbers become visible
-- in their order. Every batch changes the row and that of its attempt.
CREATE TABLE log_jobs (
    job_id text COLLATE "C" PRIMARY KEY,
    last bigint NOT NULL
) WITH (fillfactor = 50);

-- `starts` has the first numbers of the segments after the first one, `bytes` the size of the latest one.
CREATE TABLE log_attempts (
    job_id text COLLATE "C" NOT NULL,
    stage smallint NOT NULL,
    part bigint NOT NULL,
    attempt bigint NOT NULL,
    fence bigint,
    worker bytea,
    last_from_worker bigint NOT NULL,
    bytes bigint NOT NULL,
    starts bigint[] NOT NULL,
    PRIMARY KEY (job_id, stage, part, attempt)
) WITH (fillfactor = 50);

-- `number` is even, and ascends in the job in the order of arrival. `after_cut`: lines of the same attempt
-- before this one were removed.
CREATE TABLE log_lines (
    number bigint NOT NULL,
    part bigint NOT NULL,
    attempt bigint NOT NULL,
    from_worker bigint,
    time_ms bigint NOT NULL,
    stage smallint NOT NULL,
    severity smallint NOT NULL,
    after_cut boolean NOT NULL,
    job_id text COLLATE "C" NOT NULL,
    worker bytea NOT NULL,
    message bytea NOT NULL,
    PRIMARY KEY (job_id, number)
);
CREATE INDEX log_lines_of_task ON log_lines (job_id, stage, part, number);
