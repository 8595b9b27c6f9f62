//! Faults that the device reports outside any call: errors, and the loss of the device.
//!
//! wgpu passes such errors to callbacks. They are kept here until the next call that can return one checks
//! for them. A loss is permanent: all later calls on the device fail with it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::Gpu;
use crate::{CoreError, Result};

/// Faults that were reported and not yet checked.
#[derive(Default)]
pub(super) struct Faults(Mutex<Pending>);

#[derive(Default)]
struct Pending {
    /// The first error since the last check; later errors are mostly consequences of it.
    first: Option<CoreError>,
    loss: Option<Loss>,
}

struct Loss {
    message: String,
    /// wgpu gives up a device when it cannot allocate memory for a write or a submission. It first loses the
    /// device, then reports the lack of memory.
    by_memory: bool,
}

impl Faults {
    /// Listens to `device`.
    pub(super) fn of(device: &wgpu::Device) -> Arc<Self> {
        let faults = Arc::new(Self::default());
        let kept = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error| {
            kept.report(match error {
                wgpu::Error::OutOfMemory { source } => CoreError::OutOfMemory {
                    needed_bytes: None,
                    available_bytes: None,
                    message: source.to_string(),
                },
                other => CoreError::Gpu(other.to_string()),
            });
        }));
        let kept = Arc::clone(&faults);
        // Also for the reason `Destroyed`: nothing here destroys a device, and dropping one does not trigger
        // the callback.
        device.set_device_lost_callback(move |reason, message| {
            kept.lose(if message.is_empty() { format!("{reason:?}") } else { message });
        });
        faults
    }

    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps an error for the next check.
    pub(super) fn report(&self, error: CoreError) {
        let mut pending = self.lock();
        if let (CoreError::OutOfMemory { .. }, Some(loss)) = (&error, &mut pending.loss) {
            loss.by_memory = true;
        }
        pending.first.get_or_insert(error);
    }

    fn lose(&self, message: String) {
        self.lock().loss.get_or_insert(Loss { message, by_memory: false });
    }

    /// The loss, if there was one.
    fn loss(&self) -> Option<CoreError> {
        self.lock().loss.as_ref().map(|Loss { message, by_memory }| match by_memory {
            false => CoreError::DeviceLost { message: message.clone() },
            true => CoreError::OutOfMemory {
                needed_bytes: None,
                available_bytes: None,
                message: format!("the device was lost because of it: {message}"),
            },
        })
    }

    fn take(&self) -> Option<CoreError> {
        self.lock().first.take()
    }
}

impl Gpu {
    /// The error that the device reported outside any call since the last check, if any.
    ///
    /// # Errors
    /// That error. A loss is [`CoreError::DeviceLost`], or [`CoreError::OutOfMemory`] if wgpu could not
    /// recover. After a loss every call fails with it, and a new device must be opened. After other errors
    /// the device remains usable.
    pub fn check(&self) -> Result<()> {
        if let Some(loss) = self.faults.loss() {
            return Err(loss);
        }
        let Some(error) = self.faults.take() else { return Ok(()) };
        // Using objects of a lost device is an error too, and the loss may be reported only once the device
        // is idle.
        self.poll(wgpu::PollType::wait_indefinitely())?;
        Err(self.faults.loss().unwrap_or(error))
    }

    /// Lets wgpu process the work that the device has finished.
    ///
    /// # Errors
    /// When the device was lost.
    pub(super) fn poll(&self, how: wgpu::PollType) -> Result<()> {
        polled(&self.faults, || self.device.poll(how))
    }
}

/// The outcome of `poll`. If the driver reports a loss during a wait, wgpu 30 panics in `poll`, without
/// holding any of its locks.
fn polled(faults: &Faults, poll: impl FnOnce() -> Result<wgpu::PollStatus, wgpu::PollError>) -> Result<()> {
    match catch_unwind(AssertUnwindSafe(poll)) {
        Ok(Ok(_)) => Ok(()),
        Ok(Err(error)) => Err(CoreError::Gpu(format!("waiting for the device: {error}"))),
        Err(panic) => {
            let message = panic.downcast_ref::<String>().map(String::as_str);
            let message = message.or_else(|| panic.downcast_ref::<&str>().copied());
            faults.lose(message.unwrap_or("wgpu panicked while it waited").to_owned());
            Err(faults.loss().unwrap_or_else(|| CoreError::Gpu("waiting for the device".into())))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn out_of_memory() -> CoreError {
        CoreError::OutOfMemory { needed_bytes: None, available_bytes: None, message: "staging".into() }
    }

    #[test]
    fn a_panic_in_poll_is_a_loss_with_the_drivers_message() {
        let faults = Faults::default();
        let error = polled(&faults, || {
            faults.lose("Device is lost".into());
            panic!("Error in Device::poll: Parent device is lost")
        });
        assert!(matches!(error, Err(CoreError::DeviceLost { message }) if message == "Device is lost"));
        let faults = Faults::default();
        let error = polled(&faults, || panic!("Error in Device::poll: Parent device is lost"));
        assert!(matches!(error, Err(CoreError::DeviceLost { message }) if message.contains("Device::poll")));
        assert!(matches!(faults.loss(), Some(CoreError::DeviceLost { .. })), "the loss does not stay");
    }

    #[test]
    fn a_device_lost_for_lack_of_memory_is_out_of_memory() {
        let faults = Faults::default();
        faults.lose("Out of memory".into());
        assert!(matches!(faults.loss(), Some(CoreError::DeviceLost { .. })));
        faults.report(out_of_memory());
        assert!(matches!(faults.loss(), Some(CoreError::OutOfMemory { .. })));

        let faults = Faults::default();
        faults.report(out_of_memory());
        faults.lose("unplugged".into());
        assert!(
            matches!(faults.loss(), Some(CoreError::DeviceLost { .. })),
            "that error is older than the loss"
        );
    }

    #[test]
    fn the_first_error_is_kept_and_reported_once() {
        let faults = Faults::default();
        faults.report(CoreError::Gpu("first".into()));
        faults.report(CoreError::Gpu("second".into()));
        assert!(matches!(faults.take(), Some(CoreError::Gpu(message)) if message == "first"));
        assert!(faults.take().is_none());
    }
}
