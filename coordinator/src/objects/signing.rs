//! Signed requests with which clients use the bucket themselves.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3, AwsCredential};
use object_store::path::Path as ObjectPath;
use object_store::signer::{Method, Signer};
use ring::{digest, hmac};
use url::{Position, Url};

use super::{BlobStore, ObjectError, object_path};
use crate::rate_limited_log::RateLimitedLog;

/// How long a URL is valid. A client whose token is revoked can use for this long what it got before.
const VALID_FOR: Duration = Duration::from_secs(60);
/// Shorter content is read through the coordinator: the client would make a request more for it.
pub const DIRECT_READ_FROM_BYTES: u64 = 256 << 10;
/// Most bytes of one upload: if its request breaks off, they have to be sent again.
const PART_BYTES: u64 = 256 << 20;

/// Signs URLs of the objects under a prefix of a bucket.
#[derive(Clone)]
pub struct Signing {
    signer: Arc<dyn Signer>,
    prefix: ObjectPath,
    /// Whether URLs without TLS are refused.
    needs_tls: bool,
    /// Only S3 signs the length of what a client sends.
    s3: Option<Arc<AmazonS3>>,
    /// What is shorter goes through the coordinator.
    writes_from_bytes: u64,
    part_bytes: u64,
    failures: Arc<RateLimitedLog>,
}

/// A request that a client may send.
#[derive(Debug)]
pub struct SignedRequest {
    /// Where to.
    pub url: String,
    /// Headers that it must have.
    pub headers: HashMap<String, String>,
}

impl fmt::Debug for Signing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Signing({})", self.prefix)
    }
}

impl Signing {
    /// For the objects under `prefix` of the bucket that `signer` signs for.
    pub fn new(signer: Arc<dyn Signer>, prefix: ObjectPath) -> Self {
        let failures = Arc::default();
        Self {
            signer,
            prefix,
            needs_tls: false,
            s3: None,
            writes_from_bytes: 0,
            part_bytes: PART_BYTES,
            failures,
        }
    }

    /// The same for S3, where uploads are signed too.
    pub fn of_s3(s3: Arc<AmazonS3>, prefix: ObjectPath) -> Self {
        Self { s3: Some(Arc::clone(&s3)), ..Self::new(s3, prefix) }
    }

    /// The same, which signs no URLs without TLS: a service that encrypts would send content in plain text.
    pub fn with_tls(self) -> Self {
        Self { needs_tls: true, ..self }
    }

    /// The same, which signs no uploads of less than `bytes`.
    pub fn writing_from(self, bytes: u64) -> Self {
        Self { writes_from_bytes: bytes, ..self }
    }

    /// The same, with other parts of uploads.
    #[cfg(test)]
    pub fn in_parts_of(self, bytes: u64) -> Self {
        Self { part_bytes: bytes, ..self }
    }

    /// For the objects under a prefix of its own prefix.
    pub fn under(&self, prefix: &str) -> Self {
        let under = ObjectPath::from(prefix);
        Self { prefix: self.prefix.parts().chain(under.parts()).collect(), ..self.clone() }
    }

    /// A URL for reading an object; `None` if none can be had, or only one without TLS.
    async fn to_read(&self, path: &ObjectPath) -> Option<String> {
        self.signed(Method::GET, path).await.map(Into::into)
    }

    /// A request that writes an object of `bytes`; `None` as by [`Signing::to_read`], or if the provider
    /// signs no length: then its client could write without limit.
    pub(super) async fn to_write(&self, path: &ObjectPath, bytes: u64) -> Option<SignedRequest> {
        let s3 = self.s3.as_ref()?;
        let url = self.signed(Method::PUT, path).await?;
        let credential = match s3.credentials().get_credential().await {
            Ok(credential) => credential,
            Err(error) => {
                self.failed(&error);
                return None;
            }
        };
        let url = with_length(url, &credential, bytes)?;
        Some(SignedRequest {
            url: url.into(),
            headers: HashMap::from([("content-length".to_owned(), bytes.to_string())]),
        })
    }

    /// Length of the next upload of a blob of `bytes` of which `arrived_bytes` have arrived; `None` if the
    /// rest has to go through the coordinator.
    pub(super) fn part(&self, bytes: u64, arrived_bytes: u64) -> Option<u64> {
        let rest = bytes.saturating_sub(arrived_bytes);
        let is_signed = self.s3.is_some() && rest >= self.writes_from_bytes.max(1);
        is_signed.then(|| rest.min(self.part_bytes))
    }

    async fn signed(&self, method: Method, path: &ObjectPath) -> Option<Url> {
        let path: ObjectPath = self.prefix.parts().chain(path.parts()).collect();
        match self.signer.signed_url(method, &path, VALID_FOR).await {
            Ok(url) if self.needs_tls && url.scheme() != "https" => None,
            Ok(url) => Some(url),
            // Some providers have to be asked for a signature. The coordinator can do without one.
            Err(error) => {
                self.failed(&error);
                None
            }
        }
    }

    fn failed(&self, error: &object_store::Error) {
        if let Some(count) = self.failures.count() {
            tracing::warn!(%error, count, "cannot sign requests to the bucket; transferring files from here");
        }
    }
}

/// A URL that `object_store` has signed, signed again with the length of what is sent. That library refuses
/// to sign this header, and it alone knows where the bucket is. The steps are those of Amazon's
/// "Authenticating requests: using query parameters (AWS Signature Version 4)". `None` if the credential has
/// changed since.
fn with_length(mut url: Url, credential: &AwsCredential, bytes: u64) -> Option<Url> {
    let mut query: BTreeMap<String, String> = url.query_pairs().into_owned().collect();
    query.remove("X-Amz-Signature")?;
    query.insert("X-Amz-SignedHeaders".into(), "content-length;host".into());
    let (key_id, scope) = query.get("X-Amz-Credential")?.split_once('/')?;
    if key_id != credential.key_id || query.get("X-Amz-Security-Token") != credential.token.as_ref() {
        return None;
    }
    let (scope, time) = (scope.to_owned(), query.get("X-Amz-Date")?.clone());
    let pairs = query.iter().map(|(name, value)| format!("{}={}", encoded(name), encoded(value)));
    let pairs = pairs.collect::<Vec<_>>().join("&");
    let (path, host) = (url.path(), &url[Position::BeforeHost..Position::AfterPort]);
    let request = format!(
        "PUT\n{path}\n{pairs}\ncontent-length:{bytes}\nhost:{host}\n\ncontent-length;host\nUNSIGNED-PAYLOAD"
    );
    let request = hex(digest::digest(&digest::SHA256, request.as_bytes()).as_ref());
    let mut key = format!("AWS4{}", credential.secret_key).into_bytes();
    for part in scope.split('/') {
        key = hmac_of(&key, part);
    }
    let signature = hex(&hmac_of(&key, &format!("AWS4-HMAC-SHA256\n{time}\n{scope}\n{request}")));
    url.set_query(Some(&format!("{pairs}&X-Amz-Signature={signature}")));
    Some(url)
}

fn hmac_of(key: &[u8], text: &str) -> Vec<u8> {
    hmac::sign(&hmac::Key::new(hmac::HMAC_SHA256, key), text.as_bytes()).as_ref().to_vec()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Percent-encoding as signatures have it: of all but letters, digits, "-", "_", "." and "~".
fn encoded(text: &str) -> String {
    let byte = |byte: u8| match byte {
        b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' => char::from(byte).to_string(),
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(byte).collect()
}

impl BlobStore {
    /// A URL from which a client can fetch a blob; `None` if it has to come from here, because the blobs are
    /// in no bucket, or one that cannot sign.
    pub async fn url_of(&self, digest: &str) -> Result<Option<String>, ObjectError> {
        match &self.signing {
            Some(signing) => Ok(signing.to_read(&object_path(digest)?).await),
            None => Ok(None),
        }
    }
}
