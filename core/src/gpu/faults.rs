//! What the device says on its own: errors outside any call that could return them, and its loss.
//!
//! wgpu hands such errors to callbacks. They are kept here until the next call that can return one looks. A
//! loss stays: whatever is asked of the device afterwards fails with it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::Gpu;
use crate::{CoreError, Result};

/// What was said and not looked at yet.
#[derive(Default)]
pub(super) struct Faults(Mutex<Said>);

#[derive(Default)]
struct Said {
    /// The first error since the last look; later ones mostly follow from it.
    first: Option<CoreError>,
    loss: Option<Loss>,
}

struct Loss {
    message: String,
    /// wgpu gives a device up when memory of its own ends, that of a write or a submission: it loses the
    /// device, then reports that there was no memory.
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
        // Also where the reason is `Destroyed`: nothing here destroys a device, and dropping one does not say
        // so.
        device.set_device_lost_callback(move |reason, message| {
            kept.lose(if message.is_empty() { format!("{reason:?}") } else { message });
        });
        faults
    }

    fn lock(&self) -> MutexGuard<'_, Said> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps an error for the next look.
    pub(super) fn report(&self, error: CoreError) {
        let mut said = self.lock();
        if let (CoreError::OutOfMemory { .. }, Some(loss)) = (&error, &mut said.loss) {
            loss.by_memory = true;
        }
        said.first.get_or_insert(error);
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
                message: format!("the device was lost by it: {message}"),
            },
        })
    }

    fn take(&self) -> Option<CoreError> {
        self.lock().first.take()
    }
}

impl Gpu {
    /// The error that the device reported on its own since the last look, if any.
    ///
    /// # Errors
    /// That error. After a loss ([`CoreError::DeviceLost`], or [`CoreError::OutOfMemory`] that wgpu could not
    /// get over) every call fails with it, and another device must be opened; after all others the device may
    /// be used on.
    pub fn check(&self) -> Result<()> {
        if let Some(loss) = self.faults.loss() {
            return Err(loss);
        }
        let Some(error) = self.faults.take() else { return Ok(()) };
        // Objects of a lost device are invalid, and using them is an error too; but a loss may be told only
        // once the device is idle.
        self.poll(wgpu::PollType::wait_indefinitely())?;
        Err(self.faults.loss().unwrap_or(error))
    }

    /// Lets wgpu look at what the device has done.
    ///
    /// # Errors
    /// When the device was lost.
    pub(super) fn poll(&self, how: wgpu::PollType) -> Result<()> {
        polled(&self.faults, || self.device.poll(how))
    }
}

/// The outcome of `poll`. wgpu 30 panics in it, holding none of its locks, where the driver reports a loss
/// during a wait.
fn polled(faults: &Faults, poll: impl FnOnce() -> Result<wgpu::PollStatus, wgpu::PollError>) -> Result<()> {
    match catch_unwind(AssertUnwindSafe(poll)) {
        Ok(Ok(_)) => Ok(()),
        Ok(Err(error)) => Err(CoreError::Gpu(format!("waiting for the device: {error}"))),
        Err(panic) => {
            let said = panic.downcast_ref::<String>().map(String::as_str);
            let said = said.or_else(|| panic.downcast_ref::<&str>().copied());
            faults.lose(said.unwrap_or("wgpu panicked while it waited").to_owned());
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
    fn a_panic_of_wgpu_while_it_waits_is_a_loss_with_the_drivers_words() {
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
    fn a_device_that_wgpu_gave_up_for_want_of_memory_is_out_of_memory() {
        let faults = Faults::default();
        faults.lose("Out of memory".into());
        assert!(matches!(faults.loss(), Some(CoreError::DeviceLost { .. })));
        faults.report(out_of_memory());
        assert!(matches!(faults.loss(), Some(CoreError::OutOfMemory { .. })));

        let faults = Faults::default();
        faults.report(out_of_memory());
        faults.lose("unplugged".into());
        assert!(matches!(faults.loss(), Some(CoreError::DeviceLost { .. })), "memory ended long before");
    }

    #[test]
    fn the_first_error_is_kept_and_told_once() {
        let faults = Faults::default();
        faults.report(CoreError::Gpu("first".into()));
        faults.report(CoreError::Gpu("second".into()));
        assert!(matches!(faults.take(), Some(CoreError::Gpu(message)) if message == "first"));
        assert!(faults.take().is_none());
    }
}
