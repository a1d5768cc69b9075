//! Finds and opens the layers that a stage refers to, as the crate does by itself, but none before its counts were
//! looked at (`guard`).

use std::collections::HashSet;
use std::io::{self, Cursor, Read, Seek, SeekFrom};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use openusd::ar::{Asset, DefaultResolver, ResolvedPath, Resolver};

use super::guard;

/// Bytes that tell a binary layer or a package from others.
const HEAD: u64 = 8;

/// The crate's resolver with that look.
pub(super) struct GuardedResolver {
    inner: DefaultResolver,
    /// Files that were looked at: the crate opens each more than once.
    known: Mutex<HashSet<PathBuf>>,
}

impl GuardedResolver {
    pub(super) fn new() -> GuardedResolver {
        GuardedResolver { inner: DefaultResolver::new(), known: Mutex::default() }
    }
}

impl Resolver for GuardedResolver {
    fn create_identifier(&self, asset_path: &str, anchor: Option<&ResolvedPath>) -> String {
        self.inner.create_identifier(asset_path, anchor)
    }

    fn resolve(&self, asset_path: &str) -> Option<ResolvedPath> {
        self.inner.resolve(asset_path)
    }

    fn resolve_for_new_asset(&self, asset_path: &str) -> Option<ResolvedPath> {
        self.inner.resolve_for_new_asset(asset_path)
    }

    fn open_asset(&self, resolved_path: &ResolvedPath) -> io::Result<Box<dyn Asset>> {
        let mut asset = self.inner.open_asset(resolved_path)?;
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.contains(&**resolved_path) {
            return Ok(asset);
        }
        let mut bytes = Vec::new();
        asset.by_ref().take(HEAD).read_to_end(&mut bytes)?;
        if !guard::is_checked(&bytes) {
            asset.seek(SeekFrom::Start(0))?;
            return Ok(asset);
        }
        asset.read_to_end(&mut bytes)?;
        guard::check(&bytes).map_err(|what| io::Error::other(format!("{} {what}", resolved_path.display())))?;
        known.insert(resolved_path.to_path_buf());
        Ok(Box::new(Cursor::new(bytes)))
    }
}
