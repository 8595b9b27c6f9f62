//! What a request says: its path, its query and its body, with errors as JSON.

use std::time::Duration;

use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts, Path, Query, Request};
use axum::http::request::Parts;
use axum::http::{StatusCode, header};
use serde::de::DeserializeOwned;
use tonic::metadata::{Ascii, MetadataValue};

use super::Web;
use super::answer::Fault;
use crate::access::Principal;
use crate::access::places::Kind;
use crate::connections::Visit;

/// Largest body: the configuration of a job has at most 32 KiB.
const MAX_BODY_BYTES: usize = 64 << 10;
/// Time in which a body must arrive.
const BODY_WITHIN: Duration = Duration::from_secs(20);

/// Parts of the path.
pub struct At<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for At<T> {
    type Rejection = Fault;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Fault> {
        let path = Path::from_request_parts(parts, state).await;
        path.map(|Path(path)| Self(path)).map_err(|error: PathRejection| Fault::bad(error.body_text()))
    }
}

/// The query. Its type refuses unknown names.
pub struct Asked<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Asked<T> {
    type Rejection = Fault;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Fault> {
        let query = Query::from_request_parts(parts, state).await;
        query.map(|Query(query)| Self(query)).map_err(|error: QueryRejection| Fault::bad(error.body_text()))
    }
}

/// A body of JSON; no body means all defaults. Its type refuses unknown keys.
pub struct Said<T>(pub T);

impl<T: DeserializeOwned + Default> FromRequest<Web> for Said<T> {
    type Rejection = Fault;

    async fn from_request(request: Request, web: &Web) -> Result<Self, Fault> {
        let is_json = request.headers().get(header::CONTENT_TYPE).is_some_and(|kind| {
            let kind = kind.to_str().unwrap_or_default().split(';').next().unwrap_or_default();
            kind.trim().eq_ignore_ascii_case("application/json")
        });
        // What waits for its rest lies in memory, as a message of gRPC does. The layer before has the caller.
        let caller = request.extensions().get::<Principal>().cloned().unwrap_or_else(Principal::anonymous);
        let _place = web.guard.places.to_arrive(Kind::Request, &caller).await;
        let body = axum::body::to_bytes(request.into_body(), MAX_BODY_BYTES);
        let body = tokio::time::timeout(BODY_WITHIN, body).await.map_err(|_| {
            let seconds = BODY_WITHIN.as_secs();
            Fault::with(
                StatusCode::REQUEST_TIMEOUT,
                "TOO_SLOW",
                format!("the body did not arrive within {seconds} s"),
            )
        })?;
        let body = body.map_err(|error| {
            let is_too_long = std::error::Error::source(&error)
                .is_some_and(|why| why.is::<http_body_util::LengthLimitError>());
            if is_too_long {
                let message = format!("the body has more than {MAX_BODY_BYTES} bytes");
                return Fault::with(StatusCode::PAYLOAD_TOO_LARGE, "TOO_LARGE", message);
            }
            Fault::bad(format!("the body cannot be read: {error}"))
        })?;
        if body.is_empty() {
            return Ok(Self(T::default()));
        }
        if !is_json {
            let message = "the body must be JSON, with the header `Content-Type: application/json`";
            return Err(Fault::with(StatusCode::UNSUPPORTED_MEDIA_TYPE, "BAD_ARGUMENT", message));
        }
        let read = serde_json::from_slice(&body);
        read.map(Self).map_err(|error| Fault::bad(format!("the body: {error}")))
    }
}

/// Who makes the request: its token and its connection.
pub struct Caller {
    authorization: Option<MetadataValue<Ascii>>,
    visit: Option<Visit>,
}

impl<S: Send + Sync> FromRequestParts<S> for Caller {
    type Rejection = Fault;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Fault> {
        let shown = parts.headers.get(header::AUTHORIZATION);
        let authorization = shown.and_then(|shown| MetadataValue::try_from(shown.as_bytes()).ok());
        Ok(Self { authorization, visit: Visit::in_extensions(&parts.extensions).cloned() })
    }
}

impl Caller {
    /// The same message as a call of this caller.
    pub fn asks<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        if let Some(authorization) = &self.authorization {
            request.metadata_mut().insert("authorization", authorization.clone());
        }
        if let Some(visit) = &self.visit {
            request.extensions_mut().insert(visit.clone());
        }
        request
    }
}
