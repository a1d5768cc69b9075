//! Errors of devices, each one sentence for the user.

/// Why a device cannot be used, or can no longer be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No driver offers an adapter.
    #[error("no graphics adapter found: install a Vulkan, Metal or DirectX 12 driver, or use the cpu executor")]
    NoAdapter,
    /// The number asked for is too large.
    #[error("adapter {index} does not exist: this machine has {count}, counted from 0")]
    NoSuchAdapter {
        /// Number of the adapter that was asked for, from 0.
        index: usize,
        /// Adapters of this machine.
        count: usize,
    },
    /// The driver refused a device.
    #[error("adapter {adapter} gives no device: {reason}")]
    Request {
        /// Adapter and its interface.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// The adapter computes something else than WGSL says.
    #[error("adapter {adapter} fails the start-up test: {reason}")]
    SelfTest {
        /// Adapter and its interface.
        adapter: String,
        /// The wrong result.
        reason: String,
    },
    /// A fault while running; the executor does nothing any more.
    #[error("the gpu executor stopped: {0}")]
    Fault(String),
}
