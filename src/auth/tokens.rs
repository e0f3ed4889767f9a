//! The tokens that are known, in a file: names, roles and hashes, never a token.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{ByName, Identity, Role, random_text, sha256};
use crate::private;
use crate::types::is_name;

/// What tokens begin with, so that people and scanners know one when they see it.
const PREFIX: &str = "gakp_";

/// What is known of a token.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenRecord {
    /// What its bearer may do.
    pub role: Role,
    /// Whether its bearer may see pictures.
    pub video: bool,
    /// RFC 3339.
    pub created: String,
    /// SHA-256 of the token, hexadecimal.
    pub sha256: String,
}

/// `tokens.json` in the state folder.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenFile {
    tokens: ByName<TokenRecord>,
}

/// A token that was made; the only time that it is there in full.
pub struct NewToken(String);

impl NewToken {
    /// The token, to be given to its bearer.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

/// What is wrong with the tokens.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// Reading or writing failed.
    #[error("cannot {verb} {path}: {reason}", path = path.display())]
    Io {
        /// What was tried.
        verb: &'static str,
        /// On what.
        path: PathBuf,
        /// What went wrong.
        reason: io::Error,
    },
    /// The file is not what was written.
    #[error("{path} is damaged ({reason}): mend it, or delete it and make new tokens", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        reason: serde_json::Error,
    },
    /// The name is none.
    #[error(
        "the token name {0:?} is not usable: use 1 to 64 of A-Z a-z 0-9 . _ - and begin with a letter or digit"
    )]
    Name(String),
    /// The name is taken.
    #[error("a token named {0:?} exists; revoke it first or choose another name")]
    Exists(String),
    /// There is none of that name.
    #[error("there is no token named {0:?}; `gakp token list` shows them")]
    Unknown(String),
}

impl TokenFile {
    /// The file's place in a state folder.
    pub fn path(folder: &Path) -> PathBuf {
        folder.join("tokens.json")
    }

    /// Reads it; one that is not there holds no token.
    ///
    /// # Errors
    /// [`TokenError::Io`], [`TokenError::Damaged`].
    pub fn read(path: &Path) -> Result<Self, TokenError> {
        match fs::read_to_string(path) {
            Ok(text) => serde_json::from_str(&text)
                .map_err(|reason| TokenError::Damaged { path: path.into(), reason }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(reason) => Err(TokenError::Io { verb: "read", path: path.into(), reason }),
        }
    }

    /// Writes it, readable for its owner alone; a crash leaves either the old or the new.
    ///
    /// # Errors
    /// [`TokenError::Io`].
    pub fn write(&self, path: &Path) -> Result<(), TokenError> {
        private::write_json(path, self).map_err(|reason| TokenError::Io {
            verb: "write",
            path: path.into(),
            reason,
        })
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.tokens.is_empty()
    }

    /// All of them, by name.
    pub fn records(&self) -> &ByName<TokenRecord> {
        &self.tokens
    }

    /// Makes a token.
    ///
    /// # Errors
    /// The name is none, or taken.
    pub fn create(&mut self, name: &str, role: Role, video: bool) -> Result<NewToken, TokenError> {
        if !is_name(name) {
            return Err(TokenError::Name(name.chars().take(80).collect()));
        }
        if self.tokens.contains_key(name) {
            return Err(TokenError::Exists(name.into()));
        }
        let token = format!("{PREFIX}{}", random_text());
        let created = format!("{:.0}", Timestamp::now());
        self.tokens.insert(name.into(), TokenRecord { role, video, created, sha256: sha256(&token) });
        Ok(NewToken(token))
    }

    /// Forgets a token.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn revoke(&mut self, name: &str) -> Result<(), TokenError> {
        self.tokens.remove(name).map(|_| ()).ok_or_else(|| TokenError::Unknown(name.into()))
    }

    /// Who bears `token`. Hashes are compared, so how long it takes says nothing of any token.
    pub(super) fn bearer(&self, token: &str) -> Option<Identity> {
        let hash = sha256(token);
        let (name, _) = self.tokens.iter().find(|(_, record)| record.sha256 == hash)?;
        self.named(name)
    }

    /// The bearer of the token of that name.
    pub(super) fn named(&self, name: &str) -> Option<Identity> {
        let TokenRecord { role, video, .. } = self.tokens.get(name)?;
        Some(Identity { name: name.into(), role: *role, video: *video })
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_token_is_known_by_its_hash_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = TokenFile::path(&folder.path().join("state"));
        let mut file = TokenFile::read(&path).unwrap();
        let token = file.create("desk", Role::Viewer, true).unwrap();
        file.write(&path).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert!(!text.contains(&token.reveal()[10..]), "{text}");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);

        let mut read = TokenFile::read(&path).unwrap();
        assert_eq!(read, file);
        let bearer = read.bearer(token.reveal()).unwrap();
        assert_eq!(bearer, Identity { name: "desk".into(), role: Role::Viewer, video: true });
        for wrong in
            ["", "gakp_", &token.reveal()[1..], &token.reveal().to_uppercase(), &file.tokens["desk"].sha256]
        {
            assert_eq!(read.bearer(wrong), None, "{wrong}");
        }
        assert!(matches!(read.create("desk", Role::Admin, true), Err(TokenError::Exists(_))));
        assert!(matches!(read.create("a b", Role::Admin, true), Err(TokenError::Name(_))));
        read.revoke("desk").unwrap();
        assert_eq!(read.bearer(token.reveal()), None);
        assert!(matches!(read.revoke("desk"), Err(TokenError::Unknown(_))));
        fs::write(&path, "{").unwrap();
        assert!(matches!(TokenFile::read(&path), Err(TokenError::Damaged { .. })));
    }
}
