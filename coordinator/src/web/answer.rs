//! Errors as HTTP: a status, and JSON that says what is wrong.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

/// A refused request.
#[derive(Debug)]
pub struct Fault {
    status: StatusCode,
    reason: String,
    message: String,
    /// Single fields that are wrong: name and fault.
    fields: Vec<(String, String)>,
    /// Seconds after which a repetition may succeed.
    retry_after: Option<u64>,
}

/// What a handler returns.
pub type Answer = Result<Json<Value>, Fault>;

impl Fault {
    /// A fault of the request itself.
    pub fn bad(message: impl Into<String>) -> Self {
        Self::with(StatusCode::BAD_REQUEST, "BAD_ARGUMENT", message)
    }

    /// Nothing is there.
    pub fn not_found(message: impl Into<String>) -> Self {
        Self::with(StatusCode::NOT_FOUND, "NOT_FOUND", message)
    }

    /// A fault with a status of its own.
    pub fn with(status: StatusCode, reason: &str, message: impl Into<String>) -> Self {
        let (reason, message) = (reason.to_owned(), message.into());
        Self { status, reason, message, fields: Vec::new(), retry_after: None }
    }

    /// The error of a service.
    pub fn of(status: Status) -> Self {
        let details = status.get_error_details();
        let reason = details.error_info().map(|info| info.reason.clone());
        let fields = details.bad_request().map(|bad| bad.field_violations.clone()).unwrap_or_default();
        let pause = details.retry_info().and_then(|retry| retry.retry_delay);
        Self {
            status: http_status(status.code()),
            // Errors of the transport have no reason of ours.
            reason: reason.unwrap_or_else(|| reason_of(status.code()).to_owned()),
            message: status.message().to_owned(),
            fields: fields.into_iter().map(|field| (field.field, field.description)).collect(),
            retry_after: pause.map(|pause| pause.as_secs_f64().ceil().max(1.0) as u64),
        }
    }

    /// As JSON; docs/operating/http.md lists the keys.
    pub fn json(&self) -> Value {
        let fields = self.fields.iter().map(|(field, message)| json!({"field": field, "message": message}));
        json!({"error": {
            "status": self.status.as_u16(),
            "reason": self.reason,
            "message": self.message,
            "fields": fields.collect::<Vec<_>>(),
        }})
    }
}

impl From<Status> for Fault {
    fn from(status: Status) -> Self {
        Self::of(status)
    }
}

impl IntoResponse for Fault {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(self.json())).into_response();
        let headers = response.headers_mut();
        if self.status == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        if let Some(seconds) = self.retry_after {
            headers.insert(header::RETRY_AFTER, seconds.into());
        }
        response
    }
}

/// The reason of an error of the transport, which has none of its own.
fn reason_of(code: Code) -> &'static str {
    match code {
        Code::Unavailable => "UNAVAILABLE",
        Code::DeadlineExceeded | Code::Cancelled => "TOO_SLOW",
        Code::InvalidArgument => "BAD_ARGUMENT",
        _ => "INTERNAL",
    }
}

/// The status of HTTP that says the same, so that a script can decide by it.
fn http_status(code: Code) -> StatusCode {
    match code {
        Code::InvalidArgument | Code::OutOfRange => StatusCode::BAD_REQUEST,
        Code::Unauthenticated => StatusCode::UNAUTHORIZED,
        Code::PermissionDenied => StatusCode::FORBIDDEN,
        Code::NotFound => StatusCode::NOT_FOUND,
        Code::AlreadyExists | Code::FailedPrecondition | Code::Aborted => StatusCode::CONFLICT,
        Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
        Code::Unimplemented => StatusCode::NOT_IMPLEMENTED,
        Code::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
        Code::DeadlineExceeded | Code::Cancelled => StatusCode::GATEWAY_TIMEOUT,
        Code::Ok | Code::Unknown | Code::Internal | Code::DataLoss => StatusCode::INTERNAL_SERVER_ERROR,
    }
}
