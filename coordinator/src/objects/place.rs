//! Where the blobs of all tenants are, by a URL.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::local::LocalFileSystem;
use object_store::path::Path as ObjectPath;
use object_store::prefix::PrefixStore;
use object_store::signer::Signer;
use object_store::{
    BackoffConfig, ObjectStore, ObjectStoreExt, ObjectStoreScheme, PutMode, PutOptions, RetryConfig,
};
use url::Url;

use super::{ObjectError, Signing, io_error};

/// Names the deployment whose files are in a bucket.
const MARKER: &str = "fathom-deployment";
/// How long a request is tried again.
const RETRY_FOR: Duration = Duration::from_secs(10);

/// Where the blobs of all tenants are.
#[derive(Clone, Debug)]
pub enum ObjectsAt {
    /// In a folder, usually the data directory, which a lock and its store protect.
    Folder(PathBuf),
    /// In a bucket.
    Bucket {
        /// As the user wrote it; it contains no secrets.
        url: String,
        /// The objects under the URL.
        store: Arc<dyn ObjectStore>,
        /// Signs URLs of these objects for clients; `None` if clients get everything from the coordinator.
        signing: Option<Signing>,
    },
}

impl ObjectsAt {
    /// The place that a URL names: `file:///FOLDER`, `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX` or
    /// `az://CONTAINER/PREFIX`; without one, the data directory. Keys come from the environment variables of
    /// the provider's own tools, or from the machine's role.
    ///
    /// # Errors
    /// When the URL names no object store, or its settings are incomplete. Nothing is sent.
    pub fn parse(url: Option<&str>, data_dir: &Path) -> Result<Self, ObjectError> {
        let Some(text) = url else { return Ok(Self::Folder(data_dir.to_owned())) };
        let refuse = |message: String| ObjectError::BadUrl { url: without_secrets(text), message };
        let url = Url::parse(text).map_err(|error| refuse(error.to_string()))?;
        if !url.username().is_empty() || url.password().is_some() {
            return Err(refuse("keys belong in environment variables, not in the URL".to_owned()));
        }
        if url.query().is_some() || url.fragment().is_some() {
            return Err(refuse(
                "it must end with the prefix: settings belong in environment variables".to_owned(),
            ));
        }
        let (scheme, prefix) = ObjectStoreScheme::parse(&url).map_err(|error| refuse(error.to_string()))?;
        use_one_provider();
        let failed = |error: object_store::Error| refuse(error.to_string());
        let (store, signing): (Arc<dyn ObjectStore>, Signing) = match scheme {
            ObjectStoreScheme::Local => {
                let folder = url.to_file_path();
                return folder.map(Self::Folder).map_err(|()| refuse("it names no folder".to_owned()));
            }
            ObjectStoreScheme::AmazonS3 => {
                let builder = AmazonS3Builder::from_env().with_url(text).with_retry(retries());
                let s3 = Arc::new(builder.build().map_err(failed)?);
                (Arc::clone(&s3) as _, Signing::of_s3(s3, prefix.clone()))
            }
            ObjectStoreScheme::GoogleCloudStorage => {
                let builder = GoogleCloudStorageBuilder::from_env().with_url(text).with_retry(retries());
                both(builder.build().map_err(failed)?, &prefix)
            }
            ObjectStoreScheme::MicrosoftAzure => {
                let builder = MicrosoftAzureBuilder::from_env().with_url(text).with_retry(retries());
                both(builder.build().map_err(failed)?, &prefix)
            }
            _ => {
                let message = "it must begin with file://, s3://, gs:// or az://";
                return Err(refuse(message.to_owned()));
            }
        };
        let store = Arc::new(PrefixStore::new(store, prefix));
        Ok(Self::Bucket { url: text.to_owned(), store, signing: Some(signing) })
    }

    /// The same, whose URLs `change` signs, or nobody.
    pub fn signed_by(self, change: impl FnOnce(Signing) -> Option<Signing>) -> Self {
        match self {
            Self::Bucket { url, store, signing } => {
                Self::Bucket { url, store, signing: signing.and_then(change) }
            }
            folder => folder,
        }
    }

    /// Takes a bucket, or a folder beside `data_dir`, for a deployment, whose name is written there once.
    /// Without its jobs, garbage collection would delete their files.
    ///
    /// # Errors
    /// When it has the files of another deployment, or is not available.
    pub async fn hold_for(&self, deployment: &str, data_dir: &Path) -> Result<(), ObjectError> {
        match self {
            Self::Folder(folder) if is_same_folder(folder, data_dir) => Ok(()),
            Self::Folder(folder) => {
                let name = folder.display().to_string();
                // The data directory of another coordinator names no deployment.
                for other in ["store", "database.lock"].map(|name| folder.join(name)) {
                    if other.exists() {
                        return Err(refuse_other(&name, &other.display().to_string(), deployment));
                    }
                }
                std::fs::create_dir_all(folder).map_err(io_error("create", folder))?;
                let store = LocalFileSystem::new_with_prefix(folder)?.with_fsync(true);
                hold(&store, &name, deployment).await
            }
            Self::Bucket { url, store, .. } => hold(store.as_ref(), url, deployment).await,
        }
    }

    /// Whether a bucket answers and has its marker. A missing bucket would look like one without blobs.
    ///
    /// # Errors
    /// When it does not.
    pub async fn answers(&self) -> Result<(), ObjectError> {
        match self {
            Self::Folder(_) => Ok(()),
            Self::Bucket { store, .. } => {
                store.head(&ObjectPath::from(MARKER)).await.map(drop).map_err(ObjectError::Unavailable)
            }
        }
    }
}

fn both<T: ObjectStore + Signer>(store: T, prefix: &ObjectPath) -> (Arc<dyn ObjectStore>, Signing) {
    let store = Arc::new(store);
    (Arc::clone(&store) as _, Signing::new(store, prefix.clone()))
}

fn is_same_folder(one: &Path, other: &Path) -> bool {
    let whole = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    whole(one) == whole(other)
}

fn refuse_other(place: &str, found: &str, ours: &str) -> ObjectError {
    let (place, found, ours) = (place.to_owned(), found.to_owned(), ours.to_owned());
    ObjectError::OfOther { place, found, ours, marker: MARKER.to_owned() }
}

async fn hold(store: &dyn ObjectStore, place: &str, deployment: &str) -> Result<(), ObjectError> {
    let marker = ObjectPath::from(MARKER);
    let mut options = PutOptions::from(PutMode::Create);
    for _ in 0..2 {
        match store.get(&marker).await {
            Ok(found) => {
                let found = found.bytes().await.map_err(ObjectError::Unavailable)?;
                let found = String::from_utf8_lossy(&found).trim().to_owned();
                return if found == deployment {
                    Ok(())
                } else {
                    Err(refuse_other(place, &found, deployment))
                };
            }
            Err(object_store::Error::NotFound { .. }) => {}
            Err(error) => return Err(ObjectError::Unavailable(error)),
        }
        let text = format!("{deployment}\n");
        match store.put_opts(&marker, text.into(), options.clone()).await {
            // Read again: another coordinator may have written at the same time.
            Ok(_) | Err(object_store::Error::AlreadyExists { .. }) => {}
            Err(object_store::Error::NotImplemented { .. }) => options = PutOptions::default(),
            Err(error) => return Err(ObjectError::Unavailable(error)),
        }
    }
    store.head(&marker).await.map(drop).map_err(ObjectError::Unavailable)
}

/// Names the library that encrypts for HTTP clients of this process.
pub(super) fn use_one_provider() {
    // It fails when it has been named before.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
}

/// Requests are tried again for some seconds. After that, callers decide.
pub(super) fn retries() -> RetryConfig {
    let backoff = BackoffConfig { max_backoff: Duration::from_secs(5), ..BackoffConfig::default() };
    RetryConfig { backoff, max_retries: 20, retry_timeout: RETRY_FOR }
}

/// A URL without what may be a password in it.
fn without_secrets(url: &str) -> String {
    match (url.find("://"), url.rfind('@')) {
        (Some(scheme), Some(at)) if scheme + 3 <= at => format!("{}...{}", &url[..scheme + 3], &url[at..]),
        _ => url.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(url: &str) -> Result<ObjectsAt, String> {
        ObjectsAt::parse(Some(url), Path::new("data")).map_err(|error| error.to_string())
    }

    #[test]
    fn a_url_names_a_folder_or_a_bucket() {
        let folder = |place| match place {
            Ok(ObjectsAt::Folder(folder)) => folder,
            other => panic!("{other:?}"),
        };
        assert_eq!(folder(ObjectsAt::parse(None, Path::new("data"))), Path::new("data"));
        assert_eq!(
            folder(parsed("file:///srv/fathom").map_err(|_| unreachable!())),
            Path::new("/srv/fathom")
        );
        for url in ["s3://reef/scenes", "gs://reef"] {
            assert!(matches!(parsed(url), Ok(ObjectsAt::Bucket { .. })), "{url}: {:?}", parsed(url));
        }
    }

    #[tokio::test]
    async fn a_folder_beside_the_data_directory_serves_one_deployment() {
        let dir = tempfile::tempdir().unwrap();
        let (data, other) = (dir.path().join("data"), dir.path().join("objects"));
        std::fs::create_dir_all(data.join("store")).unwrap();
        let place = |folder: &Path| ObjectsAt::Folder(folder.to_owned());
        place(&data).hold_for("one", &data).await.unwrap();
        assert!(!data.join(MARKER).exists(), "its lock protects a data directory");
        place(&other).hold_for("one", &data).await.unwrap();
        place(&other).hold_for("one", &data).await.unwrap();
        for folder in [&other, &data] {
            let refused = place(folder).hold_for("two", &dir.path().join("third")).await.unwrap_err();
            assert!(matches!(refused, ObjectError::OfOther { .. }), "{refused}");
        }
    }

    #[test]
    fn a_url_that_names_no_store_is_refused_without_its_secrets() {
        for (url, said) in [
            ("reef", "relative URL"),
            ("ftp://reef/x", "reef"),
            ("https://example.org/reef", "must begin with file://, s3://"),
            ("s3://key:secret@reef/scenes", "keys belong in environment variables"),
            ("s3://reef/scenes?endpoint=x", "settings belong in environment variables"),
            ("az://reef/scenes", "ccount"),
        ] {
            let refused = parsed(url).err().unwrap_or_default();
            assert!(refused.contains(said) && !refused.contains("secret"), "{url}: {refused}");
        }
    }
}
